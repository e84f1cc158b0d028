"""Experiments of `kind: denoiser` and `kind: trained`: networks and their training."""
