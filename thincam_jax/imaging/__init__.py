"""Parts that all cameras share: scenes, sensors, targets, operators, metrics."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
