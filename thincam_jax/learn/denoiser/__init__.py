"""A denoiser of grey images that knows no camera: its network, its training and its file."""

from thincam_jax.learn.denoiser.pictures import drawn as drawn
