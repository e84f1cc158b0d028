"""Black levels that nobody gave, of dark corners or the lowest value; hot pixels of dark frames."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from thincam_jax._core.grids import block_sum, central_blocks
from thincam_jax.measured.bayer import Pattern
from thincam_jax.measured.raw import Raw

_LIT = 0.15  # largest part of the mean light that a dark place may hold
_HOT = 8.0  # standard deviations of a dark frame
_NEAR = np.add.outer(np.arange(5) % 2, np.arange(5) % 2) == 0  # one colour, also of a mosaic


@dataclass(frozen=True, eq=False)
class FoundLevels:
    """Levels (channel, 1, 1) of "psf" and "capture", how they were found, and the PSF's corner."""

    levels: dict[str, np.ndarray]
    sources: dict[str, str]
    square: tuple[Any, ...]


def corner_levels(planes: Mapping[str, np.ndarray], square: tuple[Any, ...]) -> FoundLevels:
    """Means of a square of the PSF, for both images."""
    level = planes["psf"][square].mean(axis=(1, 2), keepdims=True, dtype=np.float64)
    level = level.astype(np.float32)
    mean = level.mean(axis=0, keepdims=True)
    levels = {
        "psf": level,
        "capture": level if len(level) == len(planes.get("capture", ())) else mean,
    }
    return FoundLevels(levels, dict.fromkeys(levels, "corner"), square)


def find_levels(
    planes: Mapping[str, np.ndarray], corner: tuple[int, int], bayer: Pattern | None
) -> FoundLevels:
    """Find black levels of a PSF and a capture (channel, y, x), both in parts of one full scale.

    The mean of the PSF's first corner that `is_dark`, beginning with the upper left. A capture that
    is darker than that was exposed otherwise: nothing is subtracted, and its level is found with
    the image. Without a dark corner the level of the PSF is the lowest median of 3×3 pixels of both
    images, which no black level exceeds, and nothing is subtracted of the capture, as of none.

    - `corner`: start and stop of a square, from each corner.
    """
    side = corner[1] - corner[0]
    squares = [(slice(None), *square) for square in _corners(planes["psf"].shape, corner)]
    for square in squares:
        found = corner_levels(planes, square)
        if is_dark(planes["psf"], found.levels["psf"], side):
            capture = planes.get("capture")
            if capture is None or not is_dark(capture, found.levels["capture"], side):
                found.sources["capture"] = "found with the image"
                found.levels["capture"] = np.zeros((1, 1, 1), np.float32)
            return found
    lowest = np.float32(min(_lowest(one, bayer) for one in planes.values())).reshape(1, 1, 1)
    levels = {"psf": lowest, "capture": np.zeros_like(lowest)}
    sources = {"psf": "lowest value", "capture": "found with the image"}
    return FoundLevels(levels, sources, squares[0])


def is_dark(image: np.ndarray, level: np.ndarray, side: int) -> bool:
    """Whether a level is as low as the darkest square of an image (channel, y, x).

    Above the darkest of all squares of `side` pixels, it lies by at most 15 % of what the mean of
    the image does.
    """
    side = min(side, *image.shape[1:])
    kept = image[:, *central_blocks(image.shape[1:], side)]
    means = block_sum(kept, side, np.float64) / side**2
    lowest = means.min(axis=(1, 2), keepdims=True)
    light = means.mean(axis=(1, 2), keepdims=True) - lowest
    return bool((level - lowest <= _LIT * light).all())


def without_hot_pixels(raw: Raw, dark: Raw) -> tuple[Raw, Raw]:
    """An image and its dark frame less the excess of hot pixels, which an examination would find.

    Those at the image's largest value get at least the median of their neighbours.
    """
    if raw.pixels.shape != dark.pixels.shape or raw.bits != dark.bits:
        return raw, dark  # refused later
    near = {"footprint": _NEAR if raw.pixels.ndim == 2 else _NEAR[..., None], "mode": "mirror"}
    around, step = scipy.ndimage.median_filter(dark.pixels, **near), raw.pixels.dtype.kind == "u"
    excess = dark.pixels.astype(float) - around
    hot = excess > _HOT * max(1.48 * float(np.median(np.abs(excess))), 0.5 * step)
    pixels = np.where(hot, raw.pixels - excess, raw.pixels)
    least = np.maximum(pixels, scipy.ndimage.median_filter(pixels, **near))
    pixels = np.where(hot & (raw.pixels == raw.pixels.max()), least, pixels)
    pixels = np.maximum(np.rint(pixels), 0) if step else pixels
    quiet = replace(dark, pixels=np.where(hot, around, dark.pixels))
    return replace(raw, pixels=pixels.astype(raw.pixels.dtype)), quiet


def _corners(shape: tuple[int, ...], corner: tuple[int, int]) -> list[tuple[slice, slice]]:
    """A square at the same distance from each corner."""
    start, stop = corner
    rows, columns = ((slice(start, stop), slice(n - stop, n - start)) for n in shape[-2:])
    return [(row, column) for row in rows for column in columns]


def _lowest(image: np.ndarray, bayer: Pattern | None) -> float:
    """Lowest median of 3×3 pixels of one colour."""
    colours = [image] if bayer is None else [image[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]
    return float(min(scipy.ndimage.median_filter(one, (1, 3, 3)).min() for one in colours))
