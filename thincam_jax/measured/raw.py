"""A measured image as the camera stored it, with its bit depth, and its validation."""

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers, without_mask
from thincam_jax._core.files import MeasurementError
from thincam_jax.imaging.defects import filled_by_neighbours, wrapped, wrapped_words
from thincam_jax.measured.bayer import Pattern

MAX_CHANNELS = 4
_LOGGER = logging.getLogger(__name__)


class CaptureFileError(MeasurementError):
    """An image file that cannot be read as a measurement."""


@dataclass(frozen=True, eq=False)
class Raw:
    """One measured image, unscaled: counts are those of the file.

    - `pixels`: (y, x) or (y, x, channel) with at most 4 channels; uint8, uint16 or float.
    - `bits`: bit depth of the camera, 8 to 16; full scale is 2^bits − 1. None (the default): that
      of the integer type (8 or 16); floats then have an unknown scale and a full scale of 1.
      10, 12 and 14 bit cameras fill the low bits of 16: give `bits`, or full scale is 16 bit.
    - `format`: "tiff", "png", "npy", or "array".
    - `name`: in messages; the path of the file.
    - `sensor_shape`: shape of the sensor, for a PSF that was computed also beyond it.
    - `bayer`, `black_level`, `white_level`: pattern and levels (counts) that its file names; None
      where it does not. The white level is then the full scale.
    - `exposure`: time by its file, s. `saturation`: count from which pixels are
      saturated, where that is below full scale.
    - `dead`: map (y, x) of pixels that are NaN or masked; in `pixels` they are filled by their
      neighbours, so that no level or largest value is taken from them. None: no such.

    **Errors**: MeasurementError for another shape or type, an empty image, infinite values, no
    value that is a number, and values above 2^bits − 1. Signed integers are refused, but not
    negative floats, from which a dark frame may have been subtracted.
    """

    pixels: np.ndarray = field(repr=False)
    bits: int | None = None
    format: str = "array"
    name: str = "the array"
    sensor_shape: tuple[int, int] | None = None
    bayer: Pattern | None = None
    black_level: float | None = None
    white_level: int | None = None
    dead: Bool[np.ndarray, "y x"] | None = field(default=None, repr=False)
    saturation: float | None = None
    exposure: float | None = None

    def __post_init__(self):
        try:
            pixels, masked = without_mask(self.pixels)
        except (ValueError, TypeError):  # rows of several lengths, random keys
            raise MeasurementError(f"{self.name}: is no array; give rows of one length") from None
        _check_shape(self.name, pixels)
        _check_type(self.name, pixels)
        bits = 8 * pixels.dtype.itemsize if self.bits is None and pixels.dtype.kind == "u" else None
        if self.bits is not None:
            bits = _announced(self.name, self.bits, pixels)
        unknown = np.isnan(pixels) if pixels.dtype.kind == "f" else np.zeros(pixels.shape, bool)
        unknown = unknown | (False if masked is None else masked)
        if unknown.any():
            dead = unknown if unknown.ndim == 2 else unknown.any(axis=2)
            _LOGGER.warning("%s: %d pixels are NaN or masked: taken as dead", self.name, dead.sum())
            object.__setattr__(self, "dead", dead if self.dead is None else dead | self.dead)
        if self.dead is not None:
            unknown = unknown | (self.dead if pixels.ndim == 2 else self.dead[..., None])
        bad = int(np.isinf(pixels).sum()) if pixels.dtype.kind == "f" else 0
        if bad or (self.dead is not None and self.dead.all()):
            raise MeasurementError(
                f"{self.name}: {bad or int(unknown.sum())} of {pixels.size} values are NaN or "
                "infinite; give finite ones"
            )
        pixels = _filled(pixels, unknown)
        if bits is not None:
            _check_range(self.name, pixels, bits)
        native = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
        object.__setattr__(self, "pixels", native)
        object.__setattr__(self, "bits", bits)

    @property
    def full_scale(self) -> float:
        """Count of a saturated pixel: white level or 2^bits − 1; 1 for floats of unknown scale."""
        if self.white_level is not None:
            return float(self.white_level)
        return 1.0 if self.bits is None else float(2**self.bits - 1)

    @property
    def channels(self) -> int:
        """Number of channels, 1 for a (y, x) image."""
        return 1 if self.pixels.ndim == 2 else self.pixels.shape[2]


def with_dead(raw: Raw, dead: np.ndarray | None) -> Raw:
    """The image with further dead pixels, if the map has its size."""
    if dead is None or dead.shape != raw.pixels.shape[:2]:
        return raw
    return replace(raw, dead=dead if raw.dead is None else dead | raw.dead)


def _filled(pixels: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """The image without its dead pixels; one channel may be a mosaic of 2×2 colours."""
    if not dead.any():
        return pixels
    found = np.where(dead, 0, pixels).astype(pixels.dtype)
    for n in range(4 if pixels.ndim == 2 else pixels.shape[2]):
        part = np.s_[n // 2 :: 2, n % 2 :: 2] if pixels.ndim == 2 else np.s_[:, :, n]
        found[part] = filled_by_neighbours(found[part], dead[part])
    return found


def _check_shape(name: str, pixels: np.ndarray) -> None:
    if pixels.size == 0:
        raise MeasurementError(f"{name}: is empty (shape {pixels.shape}); give an image")
    if pixels.ndim not in (2, 3):
        raise MeasurementError(
            f"{name}: has shape {pixels.shape}; give an image (y, x) or (y, x, channel)"
        )
    if pixels.ndim == 3 and pixels.shape[0] <= MAX_CHANNELS < pixels.shape[2] / 4:
        raise MeasurementError(
            f"{name}: has shape {pixels.shape}; give one image, pixels[0], or colours as the last "
            "axis, numpy.moveaxis(pixels, 0, -1)"
        )
    if pixels.ndim == 3 and pixels.shape[2] > MAX_CHANNELS:
        raise MeasurementError(
            f"{name}: has shape {pixels.shape}, {pixels.shape[2]} channels, where 1 to "
            f"{MAX_CHANNELS} are allowed; the channel is the last axis, (y, x, channel)"
        )


def _check_type(name: str, pixels: np.ndarray) -> None:
    kind, size = pixels.dtype.kind, pixels.dtype.itemsize
    if share := wrapped(pixels):
        raise MeasurementError(f"{name}: {wrapped_words(share)}")
    if (kind == "u" and size <= 2) or (kind == "f" and size <= 8):
        return
    advice = {
        "b": "it is a mask, not an image",
        "c": "a sensor measures real numbers: give its magnitude or real part",
        "i": "counts have no sign: save them as uint16, or as float if they may be negative",
        "u": "8 to 16 bit are read: save it as uint16, or as float",
    }.get(kind, "")
    raise MeasurementError(
        f"{name}: holds {pixels.dtype} values; give uint8, uint16 or float"
        + (f" ({advice})" if advice else "")
    )


def _announced(name: str, bits, pixels: np.ndarray) -> int:
    if isinstance(bits, bool) or not isinstance(bits, int | np.integer) or not 8 <= bits <= 16:
        raise MeasurementError(f"bits = {checks.shown(bits)}: give a whole number from 8 to 16")
    held = 8 * pixels.dtype.itemsize
    if pixels.dtype.kind == "u" and bits > held:
        raise MeasurementError(
            f"{name}: holds {held}-bit data, announced as {bits} bit; leave `bits` out, or save "
            "the capture with all its bits"
        )
    return int(bits)


def _check_range(name: str, pixels: np.ndarray, bits: int) -> None:
    largest = pixels.max()
    if largest > 2**bits - 1:
        shifted = 2 ** (16 - bits)
        left = pixels.dtype == np.uint16 and not np.bitwise_or.reduce(pixels, axis=None) % shifted
        raise MeasurementError(
            f"{name}: holds values up to {largest}, above the {2**bits - 1} of {bits} bit; "
            + (
                f"all are multiples of {shifted}, so the bits are stored at the upper end: divide "
                f"by {shifted}, or read it as 16 bit"
                if left
                else "give the bit depth of the file"
            )
        )


def image_with_contrast(
    name: str, image: Numbers, shape: tuple[int, ...] | None = None, of: str = ""
) -> Float64[np.ndarray, "y x"]:
    """A finite image that is not constant, in double precision; MeasurementError for any other.

    `shape`: the required one, that of `of`; None for any (y, x).
    """
    image = np.asarray(image)
    if image.dtype.kind not in "fiu" or image.ndim != 2 or shape not in (None, image.shape):
        wanted = "an image (y, x)" if shape is None else f"the {shape} pixels of {of}"
        raise MeasurementError(
            f"{name} has shape {image.shape} and type {image.dtype}; give real numbers on {wanted}"
        )
    image = image.astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(image)))
    if bad:
        raise MeasurementError(f"{name} has {bad} pixels that are not finite; replace them first")
    if image.size == 0 or np.ptp(image) <= 1e-12 * np.abs(image).max():
        level = f"{image.flat[0]:g} in every pixel" if image.size else "empty"
        raise MeasurementError(f"{name} is {level}: give one that shows something")
    return image
