"""Experiments of `kind: learned`: a refocusing network, its training and what it gives."""
