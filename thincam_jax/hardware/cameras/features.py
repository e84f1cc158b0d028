"""GenICam's standard features (SFNC), by which cameras of all makers are configured.

`Features` adapts a library's camera: features by name, whatever their types.
"""

from abc import abstractmethod
from collections.abc import Collection
from contextlib import AbstractContextManager
from typing import Any, Protocol, runtime_checkable

from thincam_jax.hardware.base import SOFTWARE, Camera, CameraSettings, OutOfRange, Region, Timeout

COLOURS = "Mono", "BayerGR", "BayerRG", "BayerGB", "BayerBG"
BIT_DEPTHS = {f"{colour}{bits}": bits for colour in COLOURS for bits in (8, 10, 12, 16)}
Number = int | float
Value = Number | str
_BINNING = "BinningHorizontal", "BinningVertical"
_MICROSECOND = 1e-6  # s; SFNC counts exposures in µs


@runtime_checkable
class Features(Protocol):
    """The features of an open camera."""

    def has(self, name: str) -> bool:
        """Whether a feature exists and is available now."""
        ...

    def get(self, name: str) -> Value:
        """Value of a feature; for an enumeration the entry's name."""
        ...

    def set(self, name: str, value: Value) -> None:
        """Set a value, or an enumeration's entry."""
        ...

    def limits(self, name: str) -> tuple[Number, Number, Number]:
        """Minimum, maximum and step of a number; step 0 for none."""
        ...

    def choices(self, name: str) -> tuple[str, ...]:
        """Available entries of an enumeration."""
        ...


class FeatureCamera(Camera):
    """Base of the cameras that are configured by features, with any library."""

    _features: Any
    _name: str  # in errors
    _formats: Collection[str] = BIT_DEPTHS.keys()  # supported by the driver
    _settings: CameraSettings | None = None

    @abstractmethod
    def _stop(self) -> None:
        """Stop the stream, if there is one, so that the camera can be configured."""

    @abstractmethod
    def _translated(self, operation: str) -> AbstractContextManager[None]:
        """Turn errors of the library into those of a device."""

    @property
    def sensor_shape(self) -> tuple[int, int]:
        with self._translated("read the sensor's size"):
            rows, columns = ("HeightMax", "WidthMax")
            if not self._features.has(rows):
                rows, columns = ("SensorHeight", "SensorWidth")
            return int(self._features.get(rows)), int(self._features.get(columns))

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._stop()
        rows, columns = self.sensor_shape
        with self._translated("configure"):
            now = read(self._features).binning
            shape = rows * now // settings.binning, columns * now // settings.binning
            self._require(settings, shape)
            taken = _set_to(self._features, settings, shape)
            if taken.pixel_format != settings.pixel_format:
                cause = f"at an odd row or column its format is {taken.pixel_format}"
                raise OutOfRange(self._name, "configure", cause, "give an even top and left")
        self._settings = taken
        return taken

    def _require_settings(self) -> CameraSettings:
        if self._settings is None:
            raise OutOfRange(self._name, "grab", "it has no settings", "call configure before")
        return self._settings

    @property
    def _external(self) -> bool:
        """Whether frames are triggered by a line."""
        return self._require_settings().trigger != SOFTWARE

    def _timeout(self, operation: str, cause: str) -> Timeout:
        return Timeout(self._name, operation, cause, "try again, or allow more time")

    def _no_frame(self, timeout: float, also: str = "") -> Timeout:
        settings = self._require_settings()
        remedy = "trigger again, or allow more time"
        if self._external:
            remedy = f"is the trigger connected to {settings.trigger}?"
        cause = f"no frame within {settings.exposure + timeout:g} s{also}"
        return Timeout(self._name, "wait for a frame", cause, remedy)

    def _require(self, asked: CameraSettings, shape: tuple[int, int]) -> None:
        """OutOfRange for a region, format or number that the camera does not support."""

        def refuse(what: str, allowed: str) -> OutOfRange:
            return OutOfRange(self._name, "configure", what, f"give {allowed}")

        features = self._features
        formats = [name for name in features.choices("PixelFormat") if name in self._formats]
        if asked.pixel_format not in formats:
            raise refuse(f"no pixel format {asked.pixel_format}", f"one of {', '.join(formats)}")
        source = "TriggerSource"
        sources = features.choices(source) if features.has(source) else (SOFTWARE,)
        if asked.trigger not in sources:
            raise refuse(f"no trigger source {asked.trigger}", f"one of {', '.join(sources)}")
        region = asked.region or Region(0, 0, *shape)
        bottom, right = region.top + region.height, region.left + region.width
        inside = min(region.top, region.left) >= 0 and bottom <= shape[0] and right <= shape[1]
        if not inside or min(region.height, region.width) < 1:
            raise refuse(
                f"{region} lies outside of the sensor", f"a part of {shape[0]} × {shape[1]}"
            )
        for name, pixels in (("Width", region.width), ("Height", region.height)):
            if features.has(name) and pixels < (least := features.limits(name)[0]):
                raise refuse(f"{name} of {pixels} pixels", f"at least {least}")
        if asked.bayer and asked.binning > 1:
            raise refuse(f"binning mixes the colours of {asked.pixel_format}", "binning 1")
        for name, given, unit, scale in (
            (_exposure(features), asked.exposure, " s", _MICROSECOND),
            ("Gain", asked.gain, " dB", 1.0),
            ("BlackLevel", asked.black_level, "", 1.0),
            *((name, asked.binning, "", 1.0) for name in _BINNING),
        ):
            if given is None:
                continue
            low = high = float(name in _BINNING)  # a gain that is not in dB is left unchanged
            if features.has(name):
                low, high = (limit * scale for limit in features.limits(name)[:2])
            rounding = 1e-9 * abs(given)  # of a limit that was read in other units
            if not low - rounding <= given <= high + rounding:
                raise refuse(f"{name} of {given:g}{unit}", f"{low:g} … {high:g}{unit}")


class FrameCount:
    """A camera's frame counter, continued over restarts of the stream and 16-bit overflow.

    GigE Vision counts to 65535, then 1.
    """

    def __init__(self) -> None:
        self._offset: int | None = 0
        self._last, self._next = 0, 0

    def restart(self) -> None:
        """Continue with the first frame of a new stream."""
        self._offset = None

    def number(self, counted: int) -> int:
        """Number of a frame from the camera's count."""
        if self._offset is None:
            self._offset = self._next - counted
        elif self._last - counted > 2**15:
            self._offset += 2**16 - 1
        self._last, self._next = counted, self._offset + counted + 1
        return self._offset + counted


def trigger_by_software(features: Features) -> None:
    """Configure one frame for each software trigger, with nothing automatic."""

    def put(name: str, value: str) -> None:
        if features.has(name):
            _put(features, name, value)

    put("ExposureAuto", "Off")
    put("GainAuto", "Off")
    put("AcquisitionMode", "Continuous")
    for selector in features.choices("TriggerSelector"):
        put("TriggerSelector", selector)
        put("TriggerMode", "On" if selector == "FrameStart" else "Off")
    put("TriggerSelector", "FrameStart")
    put("TriggerSource", SOFTWARE)


def _set_to(features: Features, asked: CameraSettings, shape: tuple[int, int]) -> CameraSettings:
    """Apply the nearest settings, with a sensor of that shape, and return the actual ones."""
    features.set("PixelFormat", asked.pixel_format)
    region = asked.region or Region(0, 0, *shape)
    for offset in ("OffsetX", "OffsetY"):  # first 0, so that every size fits
        if features.has(offset):
            _put(features, offset, features.limits(offset)[0])
    for name, pixels in (
        *((name, asked.binning) for name in _BINNING),
        ("Width", region.width),
        ("Height", region.height),
        ("OffsetX", region.left),
        ("OffsetY", region.top),
    ):
        if features.has(name):
            _put(features, name, _nearest(pixels, *features.limits(name)))
    _put_within(features, _exposure(features), asked.exposure / _MICROSECOND)
    if features.has("Gain"):
        _put_within(features, "Gain", asked.gain)
    if asked.black_level is not None and features.has("BlackLevel"):
        _put_within(features, "BlackLevel", asked.black_level)
    for name, value in (("TriggerSource", asked.trigger), ("TriggerActivation", "RisingEdge")):
        if features.has(name):
            _put(features, name, value)
    return read(features)


def read(features: Features) -> CameraSettings:
    """Present settings of the camera."""

    def pixels(name: str) -> int:
        return int(features.get(name)) if features.has(name) else 0

    region = Region(pixels("OffsetY"), pixels("OffsetX"), pixels("Height"), pixels("Width"))
    gain = float(features.get("Gain")) if features.has("Gain") else 0.0
    exposure = float(features.get(_exposure(features))) * _MICROSECOND
    level = float(features.get("BlackLevel")) if features.has("BlackLevel") else None
    form, binning = str(features.get("PixelFormat")), pixels(_BINNING[0]) or 1
    trigger = text(features, "TriggerSource") or SOFTWARE
    return CameraSettings(exposure, region, form, gain, level, binning, trigger)


def _exposure(features: Features) -> str:
    return "ExposureTime" if features.has("ExposureTime") else "ExposureTimeAbs"  # GigE before 2.0


def _nearest(value: int, low: Number, high: Number, step: Number) -> int:
    step = step or 1
    last = low + (high - low) // step * step
    return int(min(max(low + round((value - low) / step) * step, low), last))


def _put(features: Features, name: str, value: Value) -> None:
    """Set a feature unless it has that value, which may be read-only."""
    if features.get(name) != value:
        features.set(name, value)


def _put_within(features: Features, name: str, value: float) -> None:
    low, high, _ = features.limits(name)
    _put(features, name, min(max(value, low), high))


def text(features: Features, name: str) -> str:
    """Value of a text feature, "" where the camera lacks it."""
    return str(features.get(name)) if features.has(name) else ""
