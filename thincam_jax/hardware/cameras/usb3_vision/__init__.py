"""USB3 Vision cameras over pyusb: GenCP for control, GenApi for the features, leader to trailer."""

from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera as Usb3VisionCamera
