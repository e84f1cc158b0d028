"""Writing an image, linear or for display, and its log."""

import dataclasses
import io
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile
from jaxtyping import UInt8

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.files import write_whole
from thincam_jax.imaging.encoding import eight_bit, png_bytes
from thincam_jax.measured.options import Preparation
from thincam_jax.measured.raw import MeasurementError


@dataclass(frozen=True)
class ImageLog:
    """One image before its channels and pixels were changed.

    - `name`, `format`, `shape`, `bits`, `full_scale`: properties of its file.
    - `minimum`, `maximum`: in counts. `pixels_at_maximum`: many have saturated, whatever the
      converter's highest level.
    - `background`: source of `level`, what was subtracted, the mean of each channel in fractions of
      full scale: "corner", "number", "black level of the file", the name of the dark frame; "lowest
      value" or "found with the image" where it is unknown.
    - `clipped`: pixels that this made negative, and that became 0.
    - `saturated`, `dead`: pixels. `noise`: by a sensor's calibration, root mean square, counts.
    """

    name: str
    format: str
    shape: tuple[int, ...]
    bits: int | None
    full_scale: float
    minimum: float
    maximum: float
    pixels_at_maximum: int
    background: str
    level: tuple[float, ...]
    clipped: int
    saturated: int
    dead: int
    noise: float | None = None


@dataclass(frozen=True)
class CleanUp:
    """Values of a PSF that were set to zero: below `level` in each channel.

    `zeroed`: their number; `light_removed`: their share of the light.
    """

    level: tuple[float, ...]
    zeroed: int
    light_removed: float


@dataclass(frozen=True)
class Centring:
    """Shift of a PSF by whole pixels, rows and columns.

    `found`: its centre before, pixels from the first; `light_lost`: share shifted out of the array.
    """

    found: tuple[float, float]
    shift: tuple[int, int]
    light_lost: float


@dataclass(frozen=True)
class PreparationLog:
    """Record of the steps of `prepare`; `dataclasses.asdict` gives it for a JSON file.

    - `psf`, `capture`: the images as they were read. `valid_share`: trusted pixels of the capture.
    - `psf_shape`: shape of the PSF on the capture's pixels, before `downsample`.
    - `first_pixel`, `cropped_to`: part of the capture that whole blocks of `downsample` cover;
      `shape`: after them.
    - `noise`: standard deviation of the PSF's pixels, for each channel.
    - `psf_divisor`, `capture_divisor`: divisors of fractions of full scale.
    """

    options: Preparation
    psf: ImageLog
    capture: ImageLog
    valid_share: float
    psf_shape: tuple[int, int]
    first_pixel: tuple[int, int]
    cropped_to: tuple[int, int]
    shape: tuple[int, int]
    noise: tuple[float, ...]
    clean_up: CleanUp
    centring: Centring | None
    psf_divisor: tuple[float, ...]
    capture_divisor: float


LINEAR = (".npy", ".tif", ".tiff")
Log = Mapping[str, Any] | PreparationLog
WhiteBalance = tuple[float | int, float | int, float | int] | Literal["grey_world"] | None


@checked
def write_image(
    path: str | os.PathLike[str],
    image: Numbers,
    log: Log | None = None,
    *,
    white_balance: WhiteBalance = None,
    gamma: float | int = 2.2,
    percentile: float | int = 99.9,
) -> Path:
    """Write a linear image (channel, y, x), and `log` beside it as NAME.json.

    By suffix: `.png` 8 bit for viewing, by `to_display` with the keyword arguments, whose gamma it
    says; `.npy`, `.tif` and `.tiff` float32, linear, (y, x) or (y, x, channel). The folder must
    exist. The log is written first, so that no image is without it.

    **Errors**: MeasurementError for another suffix and an image that cannot be displayed; OSError
    where writing fails.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", *LINEAR):
        raise MeasurementError(
            f"{path}: images are written as .png (for looking at), .npy or .tif (linear); "
            "give one of these suffixes"
        )
    if suffix == ".png":
        shown = to_display(image, white_balance=white_balance, gamma=gamma, percentile=percentile)
        content = png_bytes(shown, gamma)
    else:
        content = linear_bytes(checks.numbers("image", image).astype(np.float32), suffix)
    if log is not None:
        write_whole(path.with_suffix(".json"), log_text(log))
    return write_whole(path, content)


@checked
def to_display(
    image: Numbers,
    *,
    white_balance: WhiteBalance = None,
    gamma: float | int = 2.2,
    percentile: float | int = 99.9,
) -> UInt8[np.ndarray, "y x *colour"]:
    r"""8-bit grey (y, x) or RGB (y, x, 3) of a linear image with 1 or 3 channels.

    .. math:: \mathrm{round}(255\,\mathrm{clip}(g_c I_c / w, 0, 1)^{1/\gamma})

    - `white_balance`: the gains g of red, green and blue; "grey_world" equalises the channels'
      means (negative values as 0); None: gains of 1.
    - `percentile`: w is this percentile of all g_c I_c, so that a few bright pixels do not darken
      the rest; the maximum where that is 0. Negative values are black.

    **Errors**: MeasurementError for another number of channels, values that are not finite, gains
    with an image of one channel, and numbers out of range.
    """
    linear = checks.numbers("image", image).astype(np.float64)
    if linear.ndim != 3 or linear.shape[0] not in (1, 3) or linear.size == 0:
        raise MeasurementError(
            f"an image of shape {linear.shape} cannot be displayed; give (1, y, x) or (3, y, x)"
        )
    if not np.isfinite(linear).all():
        raise MeasurementError(
            f"{np.count_nonzero(~np.isfinite(linear))} of {linear.size} values are NaN or "
            "infinite; display a finite image"
        )
    if not (0 < gamma < np.inf and 0 < percentile <= 100):
        raise MeasurementError(
            f"gamma = {gamma!r}, percentile = {percentile!r}: give a gamma above 0 (2.2 is usual) "
            "and a percentile above 0, up to 100"
        )
    balanced = np.maximum(linear, 0.0)
    balanced = balanced * _gains(balanced, white_balance)[:, None, None]
    pixels = eight_bit(balanced, gamma, percentile)
    return pixels[0] if pixels.shape[0] == 1 else np.moveaxis(pixels, 0, -1)


def _gains(image: np.ndarray, white_balance: WhiteBalance) -> np.ndarray:
    channels = image.shape[0]
    if white_balance is None:
        return np.ones(channels)
    if isinstance(white_balance, str):
        if white_balance != "grey_world":
            raise MeasurementError(
                f"white_balance = {white_balance!r}: give three gains, 'grey_world' or None"
            )
        means = image.mean(axis=(1, 2))
        # A black channel stays black.
        return np.divide(means.mean(), means, out=np.ones(channels), where=means > 0)
    gains = np.asarray(white_balance, dtype=np.float64)
    if gains.shape != (channels,) or not (np.isfinite(gains) & (gains > 0)).all():
        raise MeasurementError(
            f"white_balance = {white_balance!r} for {channels} channel(s): give one finite gain "
            "above 0 for each of red, green and blue"
        )
    return gains


@checked
def log_text(log: Log) -> str:
    """JSON with sorted keys, of a mapping or a record; numbers that are not finite are null."""
    plain = _plain(log)
    return json.dumps(plain, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def linear_bytes(image: np.ndarray, suffix: str) -> bytes:
    stored = image[0] if image.shape[0] == 1 else np.moveaxis(image, 0, -1)
    stored = np.ascontiguousarray(stored)
    buffer = io.BytesIO()
    if suffix == ".npy":
        np.save(buffer, stored, allow_pickle=False)
    else:
        colours = stored.ndim == 3 and stored.shape[2] == 3
        tifffile.imwrite(
            buffer,
            stored,
            photometric="rgb" if colours else "minisblack",
            planarconfig="contig" if stored.ndim == 3 else None,
            metadata=None,
        )
    return buffer.getvalue()


def _plain(value: Any) -> Any:
    """Convert to values that JSON can hold."""
    if dataclasses.is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    array = np.asarray(value)  # numbers and arrays of NumPy and JAX
    if array.dtype.kind not in "buif":
        raise TypeError(f"a log holds numbers, texts, lists and dicts, not {type(value).__name__}")
    return _plain(array.tolist())
