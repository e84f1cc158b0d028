"""A virtual camera whose every frame says which exposure it is."""

from collections.abc import Callable

import numpy as np
import pytest

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.virtual.devices import Faults
from thincam_jax.hardware.virtual.rig import bits_of
from thincam_jax.hardware.virtual.usb3_vision import VirtualUsb3Vision

SENSOR = (48, 64)


class Scene:
    """What the virtual camera sees: noise, and the number of the exposure in its first pixels."""

    def __init__(self) -> None:
        self.exposures = 0
        self.before_exposure: Callable[[], None] = lambda: None

    def frame(self, number: int, settings: CameraSettings) -> np.ndarray:
        """The frame of this exposure."""
        region, bits = settings.region, bits_of(settings)
        assert region is not None
        noise = np.random.default_rng(number).integers(0, 2**bits, (region.height, region.width))
        noise[0, :2] = number // 200, number % 200
        return noise.astype(np.uint16)

    @staticmethod
    def number_in(pixels: np.ndarray) -> int:
        """Which exposure a frame says that it is."""
        return int(pixels[0, 0]) * 200 + int(pixels[0, 1])

    def expose(self, settings: CameraSettings) -> np.ndarray:
        self.before_exposure()
        self.exposures += 1
        return self.frame(self.exposures - 1, settings)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def device(scene: Scene) -> VirtualUsb3Vision:
    return VirtualUsb3Vision(scene.expose, SENSOR, faults=Faults())


@pytest.fixture
def camera(device: VirtualUsb3Vision):
    with Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device)) as camera:
        yield camera
