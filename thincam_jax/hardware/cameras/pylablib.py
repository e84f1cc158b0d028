"""Cameras of Thorlabs, Andor, PCO and others, by the common interface of pylablib's cameras."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from thincam_jax._core.text import of_error
from thincam_jax.hardware import base
from thincam_jax.hardware.base import (
    SOFTWARE,
    Camera,
    CameraSettings,
    Frame,
    HardwareError,
    Identity,
    Region,
)

_BITS = {f"Mono{bits}": bits for bits in (8, 10, 12, 14, 16)}
_ROUNDING = 0.1  # of an exposure; a larger change is a limit
_EARLY = 0.99  # of an exposure, for clocks that differ


class PylablibCamera(Camera):
    """A camera supported by pylablib, whose acquisition starts anew for each frame.

    Common to all of them are exposure, region and binning; `pixel_format` says how many bits its
    counts have. A frame that came sooner than its exposure takes, or with an old number, is stale.
    """

    @dataclass(frozen=True)
    class Options:
        """`camera`: class in `pylablib.devices`, such as "Thorlabs.ThorlabsTLCamera".

        - `arguments`: arguments of that class, by name, such as {serial: "12345"}.
        - `settings`, `attributes`, `grabber_attributes`: for its `apply_settings`,
          `set_all_attribute_values` and `set_all_grabber_attribute_values`. With {trigger_mode:
          ext} frames wait for the camera's external trigger.
        """

        camera: str = ""
        arguments: Mapping[str, Any] = field(default_factory=dict)
        settings: Mapping[str, Any] = field(default_factory=dict)
        attributes: Mapping[str, Any] = field(default_factory=dict)
        grabber_attributes: Mapping[str, Any] = field(default_factory=dict)

    def __init__(self, options: Options):
        self._name = f"pylablib {options.camera}".strip()
        self._settings: CameraSettings | None = None
        self._number, self._first, self._last = 0, 0, 0
        self._camera: Any = None
        opener = _camera_class(options.camera)
        try:
            with self._translated("open"):
                self._camera = opener(**options.arguments)
                self._introduce(options)
        except BaseException:
            self.close()
            raise

    @staticmethod
    def require_libraries() -> None:
        """Raise NotFound, with what to install, where pylablib is missing."""
        try:
            import_module("pylablib")
        except ImportError as error:
            cause, install = f"its library is missing ({error})", "thincam-jax[pylablib]"
            raise base.NotFound("pylablib", "open", cause, f"pip install '{install}'") from error

    def _introduce(self, options: Options) -> None:
        camera, (module, _, kind) = self._camera, options.camera.partition(".")
        info = camera.get_device_info() if hasattr(camera, "get_device_info") else None

        def reported(*names: str) -> str:
            return next((str(getattr(info, n)) for n in names if getattr(info, n, None)), "")

        self.identity = Identity(
            reported("vendor", "manufacturer") or module,
            reported("model", "camera_model", "head_model", "product", "name") or kind,
            reported("serial_number", "serial", "cam_id"),
            reported("firmware_version", "camera_version", "version"),
        )
        self._name = str(self.identity)
        for name in options.settings.keys() - camera.get_settings(include=list(options.settings)):
            raise self._refused(f"no setting {name}", "another name in settings")
        camera.apply_settings(dict(options.settings))
        if options.attributes:
            camera.set_all_attribute_values(dict(options.attributes))
        if options.grabber_attributes:
            camera.set_all_grabber_attribute_values(dict(options.grabber_attributes))
        camera.set_frame_format("list")
        camera.set_frame_info_format("namedtuple")
        camera.set_image_indexing("rct")  # rows from the top, columns

    @property
    def sensor_shape(self) -> tuple[int, int]:
        with self._translated("read the sensor's size"):
            width, height = self._camera.get_detector_size()
            return int(height), int(width)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self.flush()
        self._settings, camera, n = None, self._camera, settings.binning
        with self._translated("configure"):
            region, exposure = self._required(settings), settings.exposure
            ends = [n * region.left, n * (region.left + region.width),
                    n * region.top, n * (region.top + region.height)]  # fmt: skip
            bins = [n, n][: len(camera.get_roi()) - 4]  # none where the camera lacks binning
            camera.set_roi(*ends, *bins)  # in single pixels
            left, right, top, bottom, *bins = map(int, camera.get_roi())
            if (bins or [1, 1]) != [n, n]:
                raise self._refused(f"binning of {n}", str(max(bins, default=1)))
            region = Region(top // n, left // n, (bottom - top) // n, (right - left) // n)
            camera.set_exposure(exposure)
            taken = float(camera.get_exposure())
            if abs(taken - exposure) > _ROUNDING * exposure:
                raise self._refused(f"an exposure of {exposure:g} s", f"{taken:g} s")
        self._settings = CameraSettings(taken, region, settings.pixel_format, binning=n)
        return self._settings

    def _required(self, asked: CameraSettings) -> Region:
        """Region requested; OutOfRange for what pylablib's common interface does not set."""
        if asked.pixel_format not in _BITS:
            raise self._refused(f"no format {asked.pixel_format}", f"one of {', '.join(_BITS)}")
        given = asked.gain, asked.black_level, asked.trigger
        if given != (0.0, None, SOFTWARE):
            raise self._refused("a gain, black level or trigger", "it in the option settings")
        rows, columns = (size // asked.binning for size in self.sensor_shape)
        region = asked.region or Region(0, 0, rows, columns)
        if region.top + region.height > rows or region.left + region.width > columns:
            raise self._refused(f"{region} is outside of the sensor", f"{rows} × {columns} or less")
        return region

    def flush(self) -> None:
        with self._translated("flush"):
            self._camera.stop_acquisition()

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings, camera = self._settings, self._camera
        if settings is None:
            raise self._refused("no settings", "them before the first frame")
        allowed, began = settings.exposure + timeout, time.monotonic()
        try:
            with self._translated("grab", began + allowed):
                camera.start_acquisition()
                camera.wait_for_frame(since="start", timeout=allowed, error_on_stopped=True)
                moment = time.monotonic()
                frames, infos = camera.read_multiple_images(rng=(0, 1), return_info=True)
                if not frames:
                    raise self._incomplete("it was lost")
                pixels = np.array(frames[0])  # of a buffer that may go
                camera.stop_acquisition()
                self._check(pixels, infos[0], moment - began, settings)
        except BaseException:
            with suppress(Exception):  # with what may still come
                camera.clear_acquisition()
            raise
        return Frame(pixels, self._number, moment, settings.exposure, _BITS[settings.pixel_format])

    def _check(
        self, pixels: np.ndarray, info: Any, seconds: float, settings: CameraSettings
    ) -> None:
        """Refuse and count a frame; its own number begins anew with a start, or goes on."""
        region = settings.region
        whole = region is not None and pixels.shape == (region.height, region.width)
        if not whole or pixels.dtype not in (np.uint8, np.uint16):
            raise self._incomplete(f"{pixels.shape} {pixels.dtype}, and {region} of uint16 is set")
        if seconds < _EARLY * settings.exposure:
            raise self._incomplete(f"it came after {seconds:g} s: a stale one")
        number = getattr(info, "framestamp", None)
        number = int(info.frame_index if number is None else number)
        if not self._number:
            self._first = number
        elif number <= self._last and number != self._first:
            raise self._incomplete(f"frame {number} came after frame {self._last}: a stale one")
        self._last, self._number = number, self._number + 1

    def close(self) -> None:
        with suppress(Exception):
            self._camera.close()

    def _refused(self, what: str, allowed: str) -> base.OutOfRange:
        return base.OutOfRange(self._name, "configure", what, f"give {allowed}")

    def _incomplete(self, cause: str) -> base.IncompleteFrame:
        return base.IncompleteFrame(self._name, "grab", cause, "take it again")

    @contextmanager
    def _translated(self, operation: str, deadline: float = np.inf) -> Iterator[None]:
        """Turn errors of pylablib, and of the maker's library below it, into those of a device."""
        try:
            yield
        except HardwareError:
            raise
        except Exception as error:
            raise self._error(operation, error, time.monotonic() >= deadline) from error

    def _error(self, operation: str, error: Exception, late: bool) -> HardwareError:
        there, cause = False, of_error(error)
        with suppress(Exception):
            there = self._camera.is_opened() and self._camera.get_exposure() > 0
        if self._camera is None:
            remedy = "connect it, install its maker's software, close other programs that use it"
            return base.NotFound(self._name, operation, cause, remedy)
        if not there:
            return base.Disconnected(self._name, operation, cause, "connect it and open it again")
        if late:
            remedy = "try again, allow more time, or connect its trigger"
            return base.Timeout(self._name, operation, "no frame came", remedy)
        if isinstance(error, self._camera.FrameTransferError):
            return self._incomplete(cause)
        return base.ProtocolError(self._name, operation, cause, "open the camera again")


def _camera_class(name: str) -> Any:
    """A class of pylablib; NotFound where there is none of that name."""
    module, _, kind = name.partition(".")
    try:
        found = getattr(import_module(f"pylablib.devices.{module}"), kind)
        _ = found.wait_for_frame, found.set_exposure, found.set_roi
    except (ImportError, AttributeError) as error:
        cause = f"no camera {name!r} with an exposure and a region ({of_error(error)})"
        remedy = 'give camera, such as "Thorlabs.ThorlabsTLCamera"'
        raise base.NotFound("pylablib", "open", cause, remedy) from error
    return found
