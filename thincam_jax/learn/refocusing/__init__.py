"""Learned refocusing of lensless captures at any distance."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
