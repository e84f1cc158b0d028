"""Designs of a plate: its glass and its hologram."""
