"""Displays, light modulators driven as a monitor, and their patterns."""
