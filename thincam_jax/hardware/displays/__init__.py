"""Displays and light modulators driven as a monitor, and what is shown on them."""
