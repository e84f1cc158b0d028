"""Displays, light modulators driven as a monitor, and their patterns."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
