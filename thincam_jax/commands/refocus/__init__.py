"""Experiments of `kind: refocus`: distances, depth maps, sharp pictures."""
