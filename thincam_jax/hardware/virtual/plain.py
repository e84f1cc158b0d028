"""Virtual devices without a protocol, where the libraries of a driver are not installed."""

import dataclasses
import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from thincam_jax.hardware.base import (
    SOFTWARE,
    Camera,
    CameraSettings,
    Frame,
    Identity,
    Region,
    Stage,
)
from thincam_jax.hardware.cameras.features import BIT_DEPTHS
from thincam_jax.hardware.errors import NotHomed, OutOfRange

TRAVEL = 50.0  # mm, of virtual stages


class PlainCamera(Camera):
    """A camera whose frames come from a function.

    - `expose`: returns the counts (y, x) of a frame exposed now, within the settings' region.
    - `shape`: rows and columns of its sensor.
    """

    def __init__(self, expose: Callable[[CameraSettings], np.ndarray], shape: tuple[int, int]):
        self.identity = Identity("thincam_jax", "plain camera", "virtual", version("thincam_jax"))
        self._expose, self._shape, self._number = expose, shape, 0
        self._settings = self.configure(CameraSettings(1e-3, pixel_format="Mono8"))

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self._shape

    def configure(self, settings: CameraSettings) -> CameraSettings:
        rows, columns = (n // settings.binning for n in self._shape)
        region = settings.region or Region(0, 0, rows, columns)
        if region.top + region.height > rows or region.left + region.width > columns:
            raise self._refused(f"{region} on {rows} × {columns} pixels", "a smaller region")
        if settings.pixel_format not in BIT_DEPTHS:
            raise self._refused(settings.pixel_format, f"one of {', '.join(BIT_DEPTHS)}")
        if settings.trigger != SOFTWARE:
            raise self._refused(f"trigger {settings.trigger}", SOFTWARE)
        self._settings = dataclasses.replace(settings, region=region)
        return self._settings

    def flush(self) -> None:
        pass  # no frame waits

    def trigger_and_grab(self, timeout: float) -> Frame:
        self._number += 1
        settings, now = self._settings, time.monotonic()
        bits = BIT_DEPTHS[settings.pixel_format]
        return Frame(self._expose(settings), self._number, now, settings.exposure, bits)

    def close(self) -> None:
        pass

    def _refused(self, what: str, allowed: str) -> OutOfRange:
        return OutOfRange(str(self.identity), "configure", what, f"give {allowed}")


class PlainStage(Stage):
    """A stage that is at once where it is sent; `on_move` gets its position, mm."""

    def __init__(self, on_move: Callable[[float], None]):
        self.identity = Identity("thincam_jax", "plain stage", "virtual", version("thincam_jax"))
        self.limits, self._on_move = (0.0, TRAVEL), on_move
        self._position: float | None = None

    @property
    def homed(self) -> bool:
        return self._position is not None

    def home(self, timeout: float = 60.0) -> None:
        self._position = 0.0
        self._on_move(0.0)

    def move_to(self, position: float, timeout: float = 60.0) -> float:
        low, high = self.limits
        if not low <= position <= high:
            what = f"{position:g} mm"
            raise OutOfRange(str(self.identity), "move", what, f"give {low:g} to {high:g} mm")
        self.position()
        self._position = round(position, 3)
        self._on_move(self._position)
        return self._position

    def position(self) -> float:
        if self._position is None:
            raise NotHomed(str(self.identity), "move", "its position is unknown", "home it before")
        return self._position

    def stop(self) -> None:
        pass  # at rest at once

    def close(self) -> None:
        pass
