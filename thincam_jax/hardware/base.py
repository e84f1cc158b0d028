"""Interfaces of cameras, stages and displays of any make.

Units are millimetres and seconds. A device is a context manager: leaving it stops what moves or
streams and releases the device. A driver raises `HardwareError` and nothing else.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import quantity, whole
from thincam_jax.measured.bayer import PATTERNS, Pattern, shifted_pattern


class HardwareError(Exception):
    """A device failed: `device`, `operation`, `cause` and `remedy` are one line each.

    Drivers raise the subclasses below. An acquisition retries after `IncompleteFrame` and
    `Timeout`, reopens the device after `Disconnected`, and stops, to be resumed, after all others.
    """

    def __init__(self, device: str, operation: str, cause: str, remedy: str):
        super().__init__(device, operation, cause, remedy)
        self.device, self.operation, self.cause, self.remedy = device, operation, cause, remedy

    def __str__(self) -> str:
        return f"{self.device}: {self.operation}: {self.cause}; {self.remedy}"


class NotFound(HardwareError):
    """No such device is connected, or the library of its driver is not installed."""


class PermissionDenied(HardwareError):
    """This user may not open the device; the remedy names a udev rule or a group."""


class Busy(HardwareError):
    """Another program, named if known, holds the device."""


class Timeout(HardwareError):
    """The device did not answer, or no frame came, within the time allowed."""


class Disconnected(HardwareError):
    """The device was unplugged, switched off or reset."""


class ProtocolError(HardwareError):
    """The answer violates the protocol: its checksum, id, length or content."""


class IncompleteFrame(HardwareError):
    """Part of a frame is missing, or its trailer says so."""


class OutOfRange(HardwareError):
    """A position, exposure, region or pattern outside the device's limits; nothing was sent."""


class Saturated(HardwareError):
    """More saturated pixels than allowed."""


class NotHomed(HardwareError):
    """The stage's position is unknown: it was not homed, or it lost steps."""


Opened = TypeVar("Opened", bound="Device")
SOFTWARE = "Software"  # the trigger that this package sends


@dataclass(frozen=True)
class Identity:
    """Identity as the device itself reports it; stored with its captures."""

    vendor: str
    model: str
    serial: str
    version: str = ""  # of its firmware

    def __str__(self) -> str:
        return f"{self.vendor} {self.model} ({self.serial})"


@dataclass(frozen=True)
class Connected:
    """A device that is there, unopened.

    - `kind`: "camera", "stage", "display" or "serial port". `driver`, `options`: names by which a
      file asks for it. `about`: its own name, or why it cannot be asked.
    """

    kind: str
    driver: str
    options: Mapping[str, Any]
    about: str

    def __str__(self) -> str:
        chosen = ", ".join(f"{name}: {value}" for name, value in self.options.items())
        return f"{self.kind} {self.driver} {{{chosen}}}: {self.about}".replace("  ", " ")


class Device(ABC):
    """An open device, with its `identity`; `Options` are those of its driver in a config file."""

    Options: type[Any]
    identity: Identity

    @classmethod
    def open(cls: type[Opened], options: Any) -> Opened:
        """Open the device that the driver's `Options` select.

        `NotFound`, `Busy` or `PermissionDenied` where that fails.
        """
        return cls(options)  # pyright: ignore[reportCallIssue]

    @classmethod
    def connected(cls) -> list[Connected]:
        """Devices of this driver that are there, found without opening or changing any.

        None where only an open device can tell.
        """
        return []

    @abstractmethod
    def close(self) -> None:
        """Stop and release the device; never raises, and may be called twice."""

    def __enter__(self: Opened) -> Opened:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@checked
@dataclass(frozen=True)
class Region:
    """Part of a sensor, in pixels: rows top … top + height − 1, columns left … left + width − 1."""

    top: Annotated[int, whole(0, 65535)]
    left: Annotated[int, whole(0, 65535)]
    height: Annotated[int, whole(1, 65536)]
    width: Annotated[int, whole(1, 65536)]


@checked
@dataclass(frozen=True)
class CameraSettings:
    """Camera settings, requested or as `Camera.configure` returns them."""

    exposure: Annotated[float, quantity("s", positive=True)]
    region: Region | None = None  # None: the whole sensor
    pixel_format: str = "Mono12"  # name of the GenICam pixel format: Mono8, BayerRG12, …
    gain: Annotated[float, quantity("dB")] = 0.0
    black_level: Annotated[float | None, quantity(optional=True)] = None  # None: the camera's own
    binning: Annotated[int, whole(1, 16)] = 1  # pixels joined along each axis; `region` counts them
    trigger: str = SOFTWARE  # GenICam's name of its source: Line0, … for an external one

    @property
    def bayer(self) -> Pattern | None:
        """Bayer pattern of the region; the format names the sensor's. None for grey ones."""
        name = self.pixel_format[:7]
        every: list[Any] = [one for one in PATTERNS if name == f"Bayer{one[:2]}"]
        top, left = (self.region.top, self.region.left) if self.region else (0, 0)
        return shifted_pattern(every[0], top, left) if every else None


@dataclass(frozen=True)
class Frame:
    """One frame as the camera delivered it.

    `number` is the camera's own frame counter, which reveals stale and dropped frames; `time` is
    the camera's clock in seconds; `pixels` (y, x) are counts from 0 to 2^bit_depth − 1.
    """

    pixels: np.ndarray  # (y, x), uint8 or uint16
    number: int
    time: float
    exposure: float  # s
    bit_depth: int


class Camera(Device):
    """A camera that exposes one frame for each trigger, its own or one at `settings.trigger`."""

    @property
    @abstractmethod
    def sensor_shape(self) -> tuple[int, int]:
        """Rows and columns of the whole sensor."""

    @abstractmethod
    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Configure the camera and return its actual settings.

        Exposure, region and gain are rounded to the nearest values that the camera supports.
        `OutOfRange` where a value lies outside the camera's limits.
        """

    @abstractmethod
    def flush(self) -> None:
        """Discard all queued frames, so that the next one answers the next trigger."""

    @abstractmethod
    def trigger_and_grab(self, timeout: float) -> Frame:
        """Trigger once and return the frame exposed then; `timeout` in s, beyond the exposure.

        With an external trigger it waits for the next one instead; earlier ones do not count.
        `Timeout` where no frame came, `IncompleteFrame` where part of it is missing, `Disconnected`
        where the camera has gone. Never a frame exposed before the trigger.
        """


def grab(camera: Camera, timeout: float) -> Frame:
    """Frame of one trigger; IncompleteFrame for None, ProtocolError for what else is no frame."""
    frame: Any = camera.trigger_and_grab(timeout)
    name, remedy = str(camera.identity), "mend its driver: see Frame"
    if frame is None:
        raise IncompleteFrame(name, "trigger", "its driver returned no frame, but None", remedy)
    known = isinstance(frame, Frame) and isinstance(frame.pixels, np.ndarray)
    facts = (frame.number, frame.time, frame.exposure, frame.bit_depth) if known else (None,)
    if not all(isinstance(fact, int | float | np.number) for fact in facts):
        cause = f"its driver returned {checks.shown(frame)}, no whole Frame"
        raise ProtocolError(name, "trigger", cause, remedy)
    return frame


class Stage(Device):
    """A linear stage with `limits`, its lowest and highest position in mm.

    It has to be homed once before it moves (`NotHomed`). `by_hand`: a person moves it, and stops
    near the position asked for; the one that is read counts.
    """

    limits: tuple[float, float]
    by_hand: ClassVar[bool] = False

    @property
    @abstractmethod
    def homed(self) -> bool:
        """Whether the position is known."""

    @abstractmethod
    def home(self, timeout: float = 60.0) -> None:
        """Find the reference switch; returns once the stage is at rest."""

    @abstractmethod
    def move_to(self, position: float, timeout: float = 60.0) -> float:
        """Move to a position in mm and return the one reached, once the stage is at rest.

        `OutOfRange`, before anything is sent, outside the `limits`.
        """

    @abstractmethod
    def position(self) -> float:
        """Present position in mm."""

    @abstractmethod
    def stop(self) -> None:
        """Stop at once; the position stays known."""

    def recall(self, readings: Mapping[float, float]) -> None:
        """Positions reached before an interruption, mm, by those asked for; one by hand offers
        them again."""


class Display(Device):
    """A display, or a light modulator driven as a monitor; `shape` is its rows and columns."""

    shape: tuple[int, int]

    @abstractmethod
    def show(self, pattern: np.ndarray) -> None:
        """Show a pattern (y, x) of uint8 levels, of the display's `shape`.

        Returns once it is presented: a frame exposed after the display's settle time sees it.
        """
