"""Interfaces of cameras, stages and displays, whoever made them.

Units are millimetres and seconds. Each device is a context manager: leaving it stops what moves or
streams and gives the device back. A driver raises `HardwareError` and nothing else.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np

from thincam_jax._core.quantity import quantity, whole

Opened = TypeVar("Opened", bound="Device")


@dataclass(frozen=True)
class Identity:
    """Which device it is, as the device itself says; kept with what it captured."""

    vendor: str
    model: str
    serial: str
    version: str = ""  # of its firmware

    def __str__(self) -> str:
        return f"{self.vendor} {self.model} ({self.serial})"


class Device(ABC):
    """A device that is open; `close` gives it back and may be called twice."""

    @property
    @abstractmethod
    def identity(self) -> Identity:
        """Vendor, model, serial number and firmware, read from the device."""

    @abstractmethod
    def close(self) -> None:
        """Stops the device and gives it back; never raises."""

    def __enter__(self: Opened) -> Opened:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class Region:
    """Part of a sensor, in pixels: rows top … top + height − 1, columns left … left + width − 1."""

    top: Annotated[int, whole(0, 65535)]
    left: Annotated[int, whole(0, 65535)]
    height: Annotated[int, whole(1, 65536)]
    width: Annotated[int, whole(1, 65536)]


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a camera, or those asked for: `Camera.configure` returns what it accepted."""

    exposure: Annotated[float, quantity("s", positive=True)]
    region: Region | None = None  # None: the whole sensor
    pixel_format: str = "Mono12"  # name of the GenICam pixel format: Mono8, Mono10, Mono12, Mono16
    gain: Annotated[float, quantity("dB")] = 0.0


@dataclass(frozen=True)
class Frame:
    """One frame as the camera gave it.

    `number` is the camera's own count of frames, from which stale and dropped ones are told;
    `time` is the camera's clock in seconds; `pixels` (y, x) are counts from 0 to 2^bit_depth − 1.
    """

    pixels: np.ndarray  # (y, x), uint8 or uint16
    number: int
    time: float
    exposure: float  # s
    bit_depth: int


class Camera(Device):
    """A camera that exposes one frame for each trigger."""

    @property
    @abstractmethod
    def sensor_shape(self) -> tuple[int, int]:
        """Rows and columns of the whole sensor."""

    @abstractmethod
    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Sets the camera, and returns what it is set to now.

        Exposure, region and gain move to the nearest that the camera has, so they may differ from
        what was asked. `OutOfRange` where a value lies outside of the camera's limits.
        """

    @abstractmethod
    def flush(self) -> None:
        """Discards every frame that waits, so that the next one answers the next trigger."""

    @abstractmethod
    def trigger_and_grab(self, timeout: float) -> Frame:
        """One trigger, and the frame exposed after it; `timeout` in s, beyond the exposure.

        `Timeout` where no frame came, `IncompleteFrame` where part of it did, `Disconnected`
        where the camera has gone. Never a frame exposed before the trigger.
        """


class Stage(Device):
    """A linear stage. It has to be homed once before it moves (`NotHomed`)."""

    @property
    @abstractmethod
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position in mm."""

    @property
    @abstractmethod
    def homed(self) -> bool:
        """Whether the stage knows where it is."""

    @abstractmethod
    def home(self, timeout: float = 60.0) -> None:
        """Finds the reference switch; returns once the stage stands still."""

    @abstractmethod
    def move_to(self, position: float, timeout: float = 60.0) -> float:
        """Moves to a position in mm and returns the one reached, once the stage stands still.

        `OutOfRange` before anything is sent where it lies outside of `limits`.
        """

    @abstractmethod
    def position(self) -> float:
        """Where the stage is now, in mm."""

    @abstractmethod
    def stop(self) -> None:
        """Stops at once; the position stays known."""


class Display(Device):
    """A display, or a light modulator driven as a monitor."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""

    @abstractmethod
    def show(self, pattern: np.ndarray) -> None:
        """Shows a pattern (y, x) of uint8 levels, of the display's `shape`.

        Returns once it is presented: a frame exposed after the display's settle time sees it.
        """
