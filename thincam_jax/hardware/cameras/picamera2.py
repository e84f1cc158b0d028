"""Cameras of the Raspberry Pi, by the public interface of picamera2 (libcamera): raw frames.

They run freely. A frame counts if its exposure began after the trigger and its metadata have the
exposure and the gain that were set: what was queued or in the pipeline before is dropped. Nothing
is automatic, and the raw counts have no white balance, no shading correction and no digital gain.
"""

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from thincam_jax._core.text import of_error
from thincam_jax.hardware import base
from thincam_jax.hardware.base import (
    SOFTWARE,
    Camera,
    CameraSettings,
    Connected,
    Frame,
    HardwareError,
    Identity,
    Region,
)
from thincam_jax.measured.containers import unpacked

# Names of libcamera, by those of GenICam without the bits.
_NAMES = {"BayerRG": "SRGGB", "BayerGR": "SGRBG", "BayerGB": "SGBRG", "BayerBG": "SBGGR"}
_NAMES |= {"Mono": "R"}
_PACKED = "_CSI2P"
_EXPOSED, _GAINED = 0.02, 0.05  # parts by which exposure and gain may be rounded
_LINE = 5e-5  # s, the longest line of a sensor: exposures are whole lines
_FRAMES = 12  # in which settings have to be seen
_WAIT = 2.0  # s beyond the exposure for one of these
_FULL = 16  # bits of the metadata's black levels, and of a left-aligned word
_STILL = {"AeEnable": False, "AwbEnable": False, "ColourGains": (1.0, 1.0)}


class RaspberryPiCamera(Camera):
    """A camera of the Raspberry Pi; `pixel_format` such as "BayerRG10", "BayerBG12" or "Mono10".

    Frames are those of the whole sensor, of which `region` is cut out. A frame's number is its time
    stamp in ns, which libcamera takes as its first row is read.
    """

    @dataclass(frozen=True)
    class Options:
        """`camera`: its number, as `rpicam-hello --list-cameras` lists it.

        - `packed`: whether frames come as 10 or 12 bit without gaps (CSI2P), less to transfer; a
          Raspberry Pi 5 has none.
        """

        camera: int = 0
        packed: bool = False

    def __init__(self, options: Options):
        self._options, self._name = options, f"picamera2 {options.camera}"
        self._settings: CameraSettings | None = None
        self._format = ("", 0)  # of libcamera, and bits
        self._camera: Any = None
        opener = _library().Picamera2
        try:
            with self._translated("open"):
                self._camera = opener(options.camera)
                known = [one for one in opener.global_camera_info() if one["Num"] == options.camera]
                model = str(self._camera.camera_properties["Model"])
                self.identity = Identity("Raspberry Pi", model, str(known[0]["Id"]))
                self._name = str(self.identity)
        except BaseException:
            self.close()
            raise

    @staticmethod
    def require_libraries() -> None:
        """Raise NotFound, with what to install, where picamera2 is missing."""
        _library()

    @classmethod
    def connected(cls) -> list[Connected]:
        found = _library().Picamera2.global_camera_info()
        return [
            Connected("camera", "picamera2", {"camera": int(one["Num"])}, str(one["Model"]))
            for one in found
        ]

    @property
    def sensor_shape(self) -> tuple[int, int]:
        with self._translated("read the sensor's size"):
            width, height = self._camera.camera_properties["PixelArraySize"]
            return int(height), int(width)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._settings = None
        region, bits = self._required(settings)
        with self._translated("configure"):
            self._prepare(settings.pixel_format, bits)
            facts = self._set(settings.exposure, settings)
            if (off := settings.exposure - _exposure(facts)) > 1e-4 * settings.exposure:
                # Whole lines, rounded down: a rounded exposure that is set again would lose a line.
                longer = self._set(settings.exposure + min(off, _LINE), settings)
                if abs(_exposure(longer) - settings.exposure) < off:
                    facts = longer
                else:
                    facts = self._set(settings.exposure, settings)
            if abs(_exposure(facts) - settings.exposure) > _tolerance(settings.exposure):
                taken = f"{_exposure(facts):g} s"
                raise self._refused(f"an exposure of {settings.exposure:g} s", taken)
            black = float(np.mean(facts["SensorBlackLevels"])) / 2 ** (_FULL - bits)
        if abs((settings.black_level or black) - black) > 1e-3:
            raise self._refused(f"a black level of {settings.black_level:g}", f"{black:g}")
        gain, name = 20 * math.log10(float(facts["AnalogueGain"])), settings.pixel_format
        self._settings = CameraSettings(_exposure(facts), region, name, gain, black)
        return self._settings

    def _required(self, asked: CameraSettings) -> tuple[Region, int]:
        """Region and bits requested; OutOfRange for what the camera lacks."""
        name = asked.pixel_format.rstrip("0123456789")
        digits = asked.pixel_format[len(name) :]
        allowed = "8", "10", "12"
        if name not in _NAMES or digits not in allowed:
            raise self._refused(f"no format {asked.pixel_format}", "BayerRG10, Mono10 and the like")
        if asked.binning != 1 or asked.trigger != SOFTWARE:
            raise self._refused("a binning or a trigger", "none")
        rows, columns = self.sensor_shape
        region = asked.region or Region(0, 0, rows, columns)
        if region.top + region.height > rows or region.left + region.width > columns:
            raise self._refused(f"{region} is outside of the sensor", f"{rows} × {columns} or less")
        with self._translated("configure"):
            limits = self._camera.camera_controls
        gain = 10 ** (asked.gain / 20)
        for what, value, (least, most, *_) in (
            ("an exposure", 1e6 * asked.exposure, limits["ExposureTime"]),
            ("a gain", gain, limits["AnalogueGain"]),
        ):
            if not least * (1 - _GAINED) <= value <= (most or math.inf) * (1 + 1e-6):
                unit = " µs" if what == "an exposure" else " times"
                between = f"{least:g} to {most:g}{unit}"
                raise self._refused(f"{what} of {value:g}{unit}", between)
        return region, int(digits)

    def _prepare(self, pixel_format: str, bits: int) -> None:
        """Configure raw frames of the whole sensor, unless they are."""
        name = _NAMES[pixel_format.rstrip("0123456789")] + str(bits)
        packed = _PACKED if self._options.packed and bits > 8 else ""
        if self._format == (name + packed, bits):
            return
        camera, (rows, columns) = self._camera, self.sensor_shape
        self._format = ("", 0)
        camera.stop()
        raw = {"format": name + packed, "size": (columns, rows)}
        camera.configure(camera.create_still_configuration(raw=raw, buffer_count=2))
        taken = camera.camera_configuration()["raw"]
        given, _, packing = taken["format"].partition("_")
        if packing and f"_{packing}" != _PACKED:
            raise self._refused(f"compressed frames, {taken['format']}", "its option packed: false")
        if tuple(taken["size"]) != (columns, rows) or given not in (name, _words(name)):
            is_now = f"{taken['format']} of {taken['size'][1]} × {taken['size'][0]} pixels"
            raise self._refused(f"{raw['format']} of {rows} × {columns} pixels", is_now)
        self._format = name + packed, bits

    def _set(self, exposure: float, settings: CameraSettings) -> Mapping[str, Any]:
        """Metadata of frames with an exposure, s, and a gain, which are set as the camera starts.

        So no frame of earlier settings is left.
        """
        gain = 10 ** (settings.gain / 20) * (1 + 1e-6)  # rounded down, too
        microseconds = math.ceil(1e6 * exposure - 1e-3)
        controls = {**_STILL, "ExposureTime": microseconds, "AnalogueGain": gain}
        self._camera.stop()
        self._camera.set_controls(controls)
        self._camera.start()
        facts: Mapping[str, Any] = {}
        for _ in range(_FRAMES):
            request = self._camera.capture_request(wait=settings.exposure + _WAIT)
            try:
                before, facts = facts, request.get_metadata()
            finally:
                request.release()
            near = abs(_exposure(facts) - exposure) <= _tolerance(exposure)
            same = before and _exposure(before) == _exposure(facts)
            if near and same and math.isclose(facts["AnalogueGain"], gain, rel_tol=_GAINED):
                return facts
        cause = f"it exposes for {_exposure(facts):g} s at a gain of {facts['AnalogueGain']:g}"
        wanted = f"not for {exposure:g} s at {gain:g}"
        raise self._refused(f"{cause}, {wanted}", "these")

    def flush(self) -> None:
        pass  # what began before the trigger is dropped by its time

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings = self._settings
        if settings is None:
            raise self._refused("no settings", "them before the first frame")
        began = time.monotonic_ns()
        end = began / 1e9 + settings.exposure + timeout
        with self._translated("grab"):
            while True:
                left = end - time.monotonic()
                if left <= 0:
                    raise base.Timeout(self._name, "grab", "no frame came", "allow more time")
                request = self._camera.capture_request(wait=left)
                try:
                    facts = request.get_metadata()
                    exposed_from = int(facts["SensorTimestamp"]) - 1e9 * _exposure(facts)
                    if exposed_from >= began and self._has_settings(facts, settings):
                        pixels = self._counts(request.make_array("raw"), settings)
                        break
                finally:
                    request.release()
        stamp, (_, bits) = int(facts["SensorTimestamp"]), self._format
        return Frame(pixels, stamp, stamp / 1e9, _exposure(facts), bits)

    def _has_settings(self, facts: Mapping[str, Any], settings: CameraSettings) -> bool:
        gain = 20 * math.log10(float(facts["AnalogueGain"]))
        exposed = math.isclose(_exposure(facts), settings.exposure, rel_tol=1e-3, abs_tol=2e-6)
        return exposed and math.isclose(gain, settings.gain, abs_tol=1e-2)

    def _counts(self, rows: np.ndarray, settings: CameraSettings) -> np.ndarray:
        """Counts of the region, of rows of bytes."""
        (height, width), (_, bits), region = self.sensor_shape, self._format, settings.region
        assert region is not None
        taken = self._camera.camera_configuration()["raw"]
        given, _, packing = taken["format"].partition("_")
        least = -(-width * bits // 8) if packing else width * (1 if bits == 8 else 2)
        if rows.ndim != 2 or len(rows) != height or rows.shape[1] < least:
            cause = f"it has the shape {rows.shape} in bytes, of {height} × {width} pixels"
            raise base.IncompleteFrame(self._name, "grab", cause, "take it again")
        if packing:
            pixels = unpacked(rows, width, bits)
        else:
            word = np.uint8 if bits == 8 else np.dtype("<u2")
            pixels = np.ascontiguousarray(rows[:, :least]).view(word)
            if bits != 8 and given.endswith(str(_FULL)):
                pixels = pixels >> (_FULL - bits)  # left-aligned, as the Raspberry Pi 5 has them
        down = slice(region.top, region.top + region.height)
        return pixels[down, region.left : region.left + region.width].copy()

    def close(self) -> None:
        with suppress(Exception):
            self._camera.stop()
        with suppress(Exception):
            self._camera.close()

    def _refused(self, what: str, allowed: str) -> base.OutOfRange:
        return base.OutOfRange(self._name, "configure", what, f"give {allowed}")

    @contextmanager
    def _translated(self, operation: str) -> Iterator[None]:
        """Turn errors of picamera2 and libcamera into those of a device."""
        try:
            yield
        except HardwareError:
            raise
        except TimeoutError as error:
            with suppress(Exception):
                self._camera.cancel_all_and_flush()
            remedy = "allow more time, or check the ribbon cable"
            raise base.Timeout(self._name, operation, "no frame came", remedy) from error
        except Exception as error:
            cause = of_error(error)
            if self._camera is None and "busy" in cause.lower():
                remedy = "end the program that uses it"
                raise base.Busy(self._name, operation, cause, remedy) from error
            if self._camera is None:
                remedy = "list cameras by rpicam-hello --list-cameras, and check the ribbon cable"
                raise base.NotFound(self._name, operation, cause, remedy) from error
            remedy = "check the ribbon cable, and open it again"
            raise base.Disconnected(self._name, operation, cause, remedy) from error


def _library() -> Any:
    try:
        return import_module("picamera2")
    except ImportError as error:
        remedy = "sudo apt install python3-picamera2, and a venv with --system-site-packages"
        cause = f"its library is missing ({error})"
        raise base.NotFound("picamera2", "open", cause, remedy) from error


def _exposure(facts: Mapping[str, Any]) -> float:
    return 1e-6 * float(facts["ExposureTime"])  # of µs


def _tolerance(exposure: float) -> float:
    return max(_EXPOSED * exposure, _LINE)


def _words(name: str) -> str:
    """Name of a format in left-aligned words of 16 bit."""
    return name.rstrip("0123456789") + str(_FULL)
