"""Experiments of `kind: learned` and `kind: denoiser`: networks and their training."""
