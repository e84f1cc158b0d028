"""One image of a PSF or a scene from single frames of several exposures."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from thincam_jax.measured.examination import plateau
from thincam_jax.measured.raw import MeasurementError, Raw

_WRONG = 0.2  # relative difference of the brightness from the times
_ALIKE = 0.9  # correlation of blurred images of one thing
_BLUR, _FEW = 5, 50  # pixels


def merge_images(
    images: Sequence[Raw],
    times: Sequence[float],
    dark: Sequence[Raw | float] | None = None,
    saturation: float | None = None,
) -> Raw:
    r"""Merge single frames of several exposures to one image, in counts of the shortest.

    For the rate r, counts/s, of a pixel, and a black level b common to all frames,
    :math:`\hat r = \sum_i t_i (y_i - b) / \sum_i t_i^2` over the exposures that do not saturate it:
    least squares for read noise, with up to 1.2 times the variance of the best weights for photon
    noise. Returned is :math:`b + \hat r t` of the shortest time t, and b as its `black_level`.

    - `times`: s. `dark`: dark frame or black level, counts, of each. None: the files' black level,
      else the one at which the shortest and the longest agree.
    - `saturation`: part of full scale from which pixels are saturated. None: full scale, or the
      largest value where many pixels share it. Saturated in all, a pixel is so in the result.

    **Errors**: MeasurementError for images of different size, bits or pattern, or that contradict
    their times.
    """
    kinds = {(one.pixels.shape, one.bits, one.bayer) for one in images}
    if len(kinds) != 1 or not min(times) > 0:
        raise MeasurementError(
            f"exposures of {times} s have the (pixels, bits, pattern) {kinds}; give images of one "
            "camera, read alike, with a time above 0 for each"
        )
    order = np.argsort(times, kind="stable")
    images, t = [images[n] for n in order], np.array([times[n] for n in order])
    counts, first = np.stack([one.pixels for one in images]).astype(float), images[0]
    most = first.full_scale * (saturation or (1.0 if first.bits else np.inf))
    if saturation is None:
        most = min([most, *(float(one.pixels.max()) for one in images if plateau(one.pixels))])
    seen = counts < most
    known = [one.black_level for one in images] if dark is None else [dark[n] for n in order]
    levels = [one.pixels if isinstance(one, Raw) else one for one in known]
    if any(one is None for one in levels):
        levels = [_common_level(counts, seen, t)] * len(t)
    common = float(np.mean(levels[0]))
    signal = counts - np.stack([np.broadcast_to(one, counts.shape[1:]) for one in levels])
    _check([one.name for one in images], signal, seen, t)
    weights = seen * t.reshape(-1, *[1] * first.pixels.ndim)
    rate = (weights * signal).sum(axis=0) / np.maximum((weights**2).sum(axis=0), 1e-300)
    top = np.float32(most if np.isfinite(most) else np.inf)
    pixels = np.minimum(common + rate * t[0], np.nextafter(top, np.float32(0)))
    dead = [one.dead for one in images if one.dead is not None]
    return replace(
        first,
        pixels=np.where(seen.any(axis=0), pixels, top).astype(np.float32),
        name=" + ".join(one.name for one in images),
        black_level=common,
        saturation=float(top) if np.isfinite(most) else None,
        dead=np.any(dead, axis=0) if dead else None,
    )


def _common_level(counts: np.ndarray, seen: np.ndarray, t: np.ndarray) -> float:
    """Level at which the shortest and the longest usable exposure agree; 0 of equal ones."""
    usable = [n for n in range(len(t)) if seen[n].sum() >= _FEW and t[n] > 1.05 * t[0]]
    if not usable:
        return 0.0
    both, ratio = seen[0] & seen[usable[-1]], t[usable[-1]] / t[0]
    near, far = (float(counts[n][both].mean()) for n in (0, usable[-1]))
    return max((ratio * near - far) / (ratio - 1), 0.0)


def _check(names: Sequence[str], signal: np.ndarray, seen: np.ndarray, t: np.ndarray) -> None:
    """Refuse neighbouring exposures that contradict their times, where their light shows it."""
    size = (_BLUR, _BLUR, *[1] * (signal.ndim - 3))
    for i in range(len(t) - 1):
        both = scipy.ndimage.minimum_filter(seen[i] & seen[i + 1], size)
        near, far = (scipy.ndimage.uniform_filter(signal[n], size)[both] for n in (i, i + 1))
        noise = float(np.median(np.abs(np.diff(signal[i], axis=1)))) / _BLUR
        if near.size < _FEW or near.std() < 8 * noise or not far.std() > 0:
            continue
        found, ratio = float(far.std() / near.std()), t[i + 1] / t[i]
        alike = float(np.corrcoef(near, far)[0, 1])
        if alike < _ALIKE or abs(found / ratio - 1) > _WRONG:
            raise MeasurementError(
                f"{names[i + 1]} is {found:.3g} times as bright as {names[i]}, like it by "
                f"{alike:.2f}, and exposed {ratio:.3g} times as long ({t[i + 1]:g} s, {t[i]:g} s); "
                "give linear images of one thing and each its `exposure`, other scenes as a folder"
            )
