"""Propagation models, from the geometric shadow to the Rayleigh-Sommerfeld integral."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
