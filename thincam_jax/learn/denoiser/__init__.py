"""A denoiser of grey images that knows no camera: its network, its training and its file."""
