"""A denoiser of grey images that knows no camera: its network, its training and its file."""

from thincam_jax._core.names import modules_of

__getattr__ = modules_of(__name__)
