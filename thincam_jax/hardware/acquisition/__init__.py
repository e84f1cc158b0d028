"""Acquisitions: a plan, its frames in a store, a journal, and resumption."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
