"""Cameras: USB3 Vision over pyusb, pylon, aravis."""
