"""One image of single frames of several exposures; black levels and hot pixels of dark frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from thincam_jax.imaging.defects import is_dark
from thincam_jax.measured.bayer import Pattern
from thincam_jax.measured.examination import plateau
from thincam_jax.measured.raw import MeasurementError, Raw

_WRONG, _ALIKE = 0.2, 0.9  # relative difference of brightness and times; correlation, blurred
_BLUR, _FEW = 5, 50  # pixels


def merge_images(
    images: Sequence[Raw],
    dark: Sequence[Raw | float] | None = None,
    saturation: float | None = None,
) -> Raw:
    r"""Merge frames y of several `exposure` t to one image, in counts of the shortest.

    Its rates are :math:`r = \sum_i t_i (y_i - b) / \sum_i t_i^2` over the frames that do not
    saturate a pixel: least squares for read noise, up to 1.2 times the least variance for photon
    noise. Returned is :math:`b + r t` of the shortest t; saturated in all, a pixel stays so.

    - `dark`: b of each, a frame or counts. None: the files' `black_level`, else the level at which
      the shortest and the longest agree, if any. The result's `black_level` is its mean.
    - `saturation`: part of full scale. None: full scale, or a plateau below.

    **Errors**: MeasurementError for unlike images, exposures that are missing or contradicted.
    """
    kinds = {(one.pixels.shape, one.bits, one.bayer) for one in images}
    names = " + ".join(one.name for one in images)
    if not all(one.exposure for one in images) or len(kinds) > 1:
        raise MeasurementError(
            f"{names} have the exposures {[one.exposure for one in images]} s and (pixels, bits, "
            f"pattern) {kinds}; merge equal images whose files or `exposure`, as 4ms, say the time "
            "of each; give other scenes as a folder"
        )
    pairs = zip(images, dark or [one.black_level for one in images], strict=True)
    images, levels = zip(*sorted(pairs, key=lambda pair: pair[0].exposure or 0), strict=True)
    t, first = np.array([one.exposure for one in images]), images[0]
    counts = np.stack([one.pixels for one in images]).astype(float)
    most = first.full_scale * (saturation or (1.0 if first.bits else np.inf))
    if saturation is None:
        most = min([most, *(float(one.pixels.max()) for one in images if plateau(one.pixels))])
    seen, last = counts < most, len(t)
    if any(one is None for one in levels):
        usable = [n for n in range(len(t)) if (seen[0] & seen[n]).sum() >= _FEW]
        last = max((n for n in usable if t[n] > 1.05 * t[0]), default=0)
        both, ratio = seen[0] & seen[last], t[last] / t[0]
        above = (ratio * counts[0] - counts[last])[both]
        levels = [max(float(above.mean()) / (ratio - 1), 0.0) if last else 0.0] * len(t)
    levels = [one.pixels if isinstance(one, Raw) else one for one in levels]
    signal = counts - np.stack([np.broadcast_to(one, counts.shape[1:]) for one in levels])
    _check(images, signal, seen)
    weights = seen * t.reshape(-1, *[1] * (counts.ndim - 1))
    rate = (weights * signal).sum(axis=0) / np.maximum((weights**2).sum(axis=0), 1e-300)
    level, below = float(np.mean(levels[0])), np.nextafter(np.float32(most), np.float32(0))
    pixels = np.where(seen.any(axis=0), np.minimum(level + rate * t[0], below), most)
    dead = [one.dead for one in images if one.dead is not None]
    facts = {"saturation": most} if np.isfinite(most) else {}
    facts |= {
        "black_level": level if last else None,
        "dead": np.any(dead, axis=0) if dead else None,
    }
    return replace(first, pixels=pixels.astype(np.float32), name=names, **facts)


def _check(images: Sequence[Raw], signal: np.ndarray, seen: np.ndarray) -> None:
    """Refuse neighbouring exposures that contradict their times, where their light shows it."""
    size = (_BLUR, _BLUR, *[1] * (signal.ndim - 3))
    for i, (one, other) in enumerate(zip(images, images[1:], strict=False)):
        both = scipy.ndimage.minimum_filter(seen[i] & seen[i + 1], size)
        near, far = (scipy.ndimage.uniform_filter(signal[n], size)[both] for n in (i, i + 1))
        noise = float(np.median(np.abs(np.diff(signal[i], axis=1)))) / _BLUR
        if near.size < _FEW or near.std() < 8 * noise or not far.std() > 0:
            continue
        found, ratio = float(far.std() / near.std()), (other.exposure or 0) / (one.exposure or 1)
        alike = float(np.corrcoef(near, far)[0, 1])
        if alike < _ALIKE or abs(found / ratio - 1) > _WRONG:
            raise MeasurementError(
                f"{other.name} is {found:.3g} times as bright as {one.name}, alike by {alike:.2f}, "
                f"and exposed {ratio:.3g} times as long; give linear images of one, and `exposure`"
            )


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
