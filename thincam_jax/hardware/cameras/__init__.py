"""Cameras: aravis, pylon, pylablib, picamera2."""
