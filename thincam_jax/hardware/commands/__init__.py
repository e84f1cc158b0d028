"""Experiments of `kind: capture`: what the rig takes, and what is reconstructed from it."""
