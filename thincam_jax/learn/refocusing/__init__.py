"""Learned refocusing of lensless captures at any distance."""
