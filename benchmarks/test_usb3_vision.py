"""How fast the USB3 Vision client takes frames of 2048² pixels from the virtual camera.

Client and camera share one process and one thread; the frames are ready before they are asked for,
but those of Mono12p are packed by the camera, which takes longer than the client does to unpack.
A camera of the thesis's size has to give 25 frames a second.
"""

import numpy as np
import pytest

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.virtual.usb3_vision import VirtualUsb3Vision

SHAPE = (2048, 2048)


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono12", "Mono12p"])
def test_frames_of_4_megapixels(benchmark, pixel_format):
    counts = 256 if pixel_format == "Mono8" else 4096
    frame = np.random.default_rng(0).integers(0, counts, SHAPE).astype(np.uint16)
    device = VirtualUsb3Vision(lambda settings: frame, SHAPE)
    with Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device)) as camera:
        camera.configure(CameraSettings(1e-3, pixel_format=pixel_format))
        taken = benchmark(camera.trigger_and_grab, 1.0)
    benchmark.extra_info["frames_per_second"] = 1 / benchmark.stats["median"]
    assert np.array_equal(taken.pixels, frame)
