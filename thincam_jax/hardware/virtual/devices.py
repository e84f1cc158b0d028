"""The devices of a virtual rig, opened by the drivers of real ones.

Stages use the real protocols, of Zaber and GRBL on pseudo-terminals, and a camera of pylon the
vendor's emulator. Another camera and the display have no protocol. Nothing listens on a network.
Where the library of a driver is missing, a plain device takes its place.
"""

import dataclasses
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from importlib.metadata import version
from typing import Any, Literal, get_args

import numpy as np

from thincam_jax.hardware import registry
from thincam_jax.hardware.base import (
    SOFTWARE,
    Camera,
    CameraSettings,
    Display,
    Frame,
    Identity,
    NotFound,
    NotHomed,
    OutOfRange,
    Region,
    Stage,
)
from thincam_jax.hardware.cameras.features import BIT_DEPTHS
from thincam_jax.hardware.displays.levels import GreyLevelDisplay
from thincam_jax.hardware.stages.manual import ManualStage
from thincam_jax.hardware.virtual.rig import VirtualRig

Fault = Literal[
    "latency",  # the answer or the frame comes late, within the timeout
    "stale_frame",  # the previous frame, with its old number
    "short_frame",  # part of the payload is missing
    "dropped_frame",  # no frame comes
    "unplug",  # the device disconnects, and can be reopened
    "nak",  # the device refuses a valid command
    "busy",  # the device is not ready
    "lost_steps",  # the stage is not at its commanded position
    "wrong_checksum",  # the answer's checksum is wrong
]
FAULTS: tuple[Fault, ...] = get_args(Fault)


class Faults:
    """Pending faults of a device; thread-safe.

    `inject` adds one; the device calls `due` where the fault would occur, and plays it if that is
    True. `happened` counts the played ones.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: Counter[Fault] = Counter()
        self.happened: Counter[Fault] = Counter()

    def inject(self, fault: Fault, times: int = 1) -> None:
        """Add a fault, `times` times."""
        if fault not in FAULTS:
            raise ValueError(f"{fault!r} is no fault; give one of {', '.join(FAULTS)}")
        with self._lock:
            self._waiting[fault] += times

    def due(self, fault: Fault) -> bool:
        """Whether to play this fault now; consumes one."""
        with self._lock:
            if not self._waiting[fault]:
                return False
            self._waiting[fault] -= 1
            self.happened[fault] += 1
            return True

    def waiting(self) -> bool:
        """Whether faults are pending."""
        with self._lock:
            return self._waiting.total() > 0


TRAVEL = 50.0  # mm, of virtual stages


_LEAST, _LONGEST = 1e-5, 10.0  # s, exposures of the virtual camera
LINE, LINE_PERIOD = "Line0", 0.02  # an external trigger of the virtual camera, s between pulses


class VirtualCamera(Camera):
    """A camera whose frames come from a function, without a protocol.

    It exposes at once, or with the trigger `LINE` at the next pulse of a clock.

    - `expose`: returns the counts (y, x) of a frame exposed now, within the settings' region.
    - `shape`: rows and columns of its sensor.
    """

    def __init__(self, expose: Callable[[CameraSettings], np.ndarray], shape: tuple[int, int]):
        self.identity = Identity("thincam_jax", "virtual camera", "virtual", version("thincam_jax"))
        self._expose, self._shape, self._number = expose, shape, 0
        self._settings = self.configure(CameraSettings(1e-3, pixel_format="Mono8"))

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self._shape

    def configure(self, settings: CameraSettings) -> CameraSettings:
        rows, columns = (n // settings.binning for n in self._shape)
        region = settings.region or Region(0, 0, rows, columns)
        if region.top + region.height > rows or region.left + region.width > columns:
            what = f"{region} lies outside of the sensor"
            raise self._refused(what, f"a part of {rows} × {columns}")
        if not _LEAST <= round(settings.exposure, 9) <= _LONGEST:  # 10 us are a bit less than 1e-5
            what = f"ExposureTime of {settings.exposure:g} s"
            raise self._refused(what, f"{_LEAST:g} … {_LONGEST:g} s")
        if settings.pixel_format not in BIT_DEPTHS:
            raise self._refused(settings.pixel_format, f"one of {', '.join(BIT_DEPTHS)}")
        if settings.bayer and settings.binning > 1:
            what = f"binning mixes the colours of {settings.pixel_format}"
            raise self._refused(what, "binning 1")
        if settings.black_level is not None:
            raise self._refused("it has no black level", "the offset of the virtual rig")
        if settings.trigger not in (SOFTWARE, LINE):
            what = f"no trigger source {settings.trigger}"
            raise self._refused(what, f"one of {SOFTWARE}, {LINE}")
        self._settings = dataclasses.replace(settings, region=region)
        return self._settings

    def flush(self) -> None:
        pass  # no frame waits

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings = self._settings
        if settings.trigger == LINE:
            time.sleep(-time.monotonic() % LINE_PERIOD)
        self._number += 1
        now, bits = time.monotonic(), BIT_DEPTHS[settings.pixel_format]
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


class VirtualDisplay(GreyLevelDisplay):
    """A display that calls `on_show` with the levels (y, x), uint8, of each pattern."""

    identity = Identity("thincam_jax", "virtual display", "virtual", version("thincam_jax"))

    def __init__(self, shape: tuple[int, int], on_show: Callable[[np.ndarray], None]):
        super().__init__()
        self.shape, self._on_show = shape, on_show

    def close(self) -> None:
        pass

    def _present(self, levels: np.ndarray) -> None:
        self._on_show(levels)


class VirtualDevices(AbstractContextManager["VirtualDevices"]):
    """The devices of one `VirtualRig`; a context manager.

    `camera`, `stage` and `display` connect, repeatedly, as the openers of an acquisition's rig. A
    reopened device is the same one: a stage stays homed as long as it has power.
    """

    def __init__(self, rig: VirtualRig):
        self.rig = rig
        self._there: dict[str, Any] = {}
        self._powered = ExitStack()

    def camera(self, driver: str, options: Mapping[str, Any] | None = None) -> Camera:
        """Open the camera, for pylon in the vendor's emulator; `options` are checked alone."""
        if driver not in ("aravis", "pylon"):
            raise _none_virtual("cameras", driver, "aravis or pylon")
        with suppress(NotFound):  # its library is missing
            registry.read_options("cameras", driver, options)
        shape = self.rig.optics.sensor_shape
        if driver == "pylon" and not _lacks_library("cameras", driver):
            from thincam_jax.hardware.virtual.pylon import VirtualPylonCamera

            return VirtualPylonCamera(self.rig.expose, shape)
        return VirtualCamera(self.rig.expose, shape)

    def stage(self, driver: str, options: Mapping[str, Any] | None = None) -> Stage:
        """Open the stage by zaber or grbl, `options` except its port; manual asks a person."""
        if driver == "manual":
            return ManualStage(ManualStage.Options(**(options or {})), self.rig.on_move)
        if driver not in ("zaber", "grbl"):
            raise _none_virtual("stages", driver, "zaber, grbl or manual")
        if _lacks_library("stages", driver):
            self._there.setdefault("stage", PlainStage(self.rig.on_move))
            return self._there["stage"]
        if "stage" not in self._there:
            from thincam_jax.hardware.virtual.grbl import VirtualGrbl
            from thincam_jax.hardware.virtual.zaber import VirtualZaber

            kind = VirtualZaber if driver == "zaber" else VirtualGrbl
            device = kind(on_move=self.rig.on_move)
            self._there["stage"] = self._powered.enter_context(device)
        port = str(self._there["stage"].port)
        return registry.open_device("stages", driver, {**(options or {}), "port": port})

    def display(self, driver: str = "", options: Mapping[str, Any] | None = None) -> Display:
        """Open the display, whose patterns go to the rig, whatever the driver and its options."""
        return VirtualDisplay(self.rig.display_shape, self.rig.on_show)

    def close(self) -> None:
        """Switch off the devices."""
        self._powered.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _lacks_library(kind: str, driver: str) -> bool:
    """Whether a driver cannot be imported, which is logged."""
    try:
        registry.driver(kind, driver)
    except NotFound as error:
        text = "%s; the virtual rig goes on without its protocol and faults"
        logging.getLogger(__name__).warning(text, error)
        return True
    return False


def _none_virtual(kind: str, driver: str, known: str) -> NotFound:
    return NotFound(driver, "open", f"there is no virtual one among the {kind}", f"use {known}")
