"""One image of a PSF or a scene from single frames of several exposures."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

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
