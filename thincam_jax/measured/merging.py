"""One image of a PSF or a scene from single frames of several exposures."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from thincam_jax._core.arguments import checked
from thincam_jax.measured.examination import plateau
from thincam_jax.measured.exposures import weighted_rate
from thincam_jax.measured.raw import MeasurementError, Raw

_WRONG = 0.2  # relative difference of the brightness from the times
_ALIKE = 0.9  # correlation of blurred images of one thing
_BLUR = 5  # pixels
_FEW = 50  # pixels
_ROUNDING = 1 / 12  # variance of whole counts


@checked
def merge_images(
    images: Sequence[Raw],
    times: Sequence[float | int],
    dark: Sequence[Raw | float | int] | None = None,
    saturation: float | int | None = None,
) -> Raw:
    r"""Merge single frames of several exposures to one image, in counts of the shortest exposure.

    The rate r of each pixel by the least squares of `merge_exposures`, over the exposures that do
    not saturate it; gain and read noise are those of the differences of two exposures. Returned is
    :math:`b + r t` of the shortest time t, with the black level b as its `black_level`: that of
    `dark` (the mean of a frame), else of the files, else the level at which all exposures agree,
    of the pixels that the longest does not saturate.

    - `times`: s. `dark`: dark frame or black level, counts, of each.
    - `saturation`: part of full scale from which pixels are saturated. None: full scale, or the
      largest value where many pixels share it.

    Pixels that every exposure saturates are saturated.

    **Errors**: MeasurementError for images of different size, bits or pattern, and for times that
    the images contradict: of other brightness than these say, or of different things.

    >>> light, random = np.geomspace(20, 60_000, 240).reshape(12, 20), np.random.default_rng(0)
    >>> def taken(time):
    ...     counts = 64 + random.poisson(light * time) + random.normal(0, 2, light.shape)
    ...     return Raw(np.clip(np.rint(counts), 0, 4095).astype(np.uint16), bits=12)
    >>> merged = merge_images([taken(0.05), taken(0.8)], [0.05, 0.8])
    >>> bool(abs(merged.black_level - 64) < 1 and merged.pixels.max() < 4095)
    True
    """
    if len(images) != len(times) or not times or not np.all(np.asarray(times) > 0):
        raise MeasurementError(f"{len(images)} images and times {times}; give one above 0 for each")
    order = np.argsort(times, kind="stable")
    images, t = [images[n] for n in order], np.array([float(times[n]) for n in order])
    first = images[0]
    for one in images[1:]:
        for name in ("shape", "bits", "bayer"):
            a, b = ((r.pixels.shape if name == "shape" else getattr(r, name)) for r in (first, one))
            if a != b:
                raise MeasurementError(
                    f"{first.name} has the {name} {a} and {one.name} {b}; merge exposures of one "
                    "camera, read alike"
                )
    counts = np.stack([one.pixels for one in images]).astype(float)
    most = first.full_scale * (saturation or (1.0 if first.bits else np.inf))
    tops = [float(one.pixels.max()) for one in images if plateau(one.pixels)]
    most = min([most, *tops]) if saturation is None else most
    seen = counts < most
    given = [first.black_level] * len(images) if dark is None else [dark[n] for n in order]
    level, common = _levels(given, counts, seen, t)
    signal = counts - level
    _check(images, signal, seen, t)
    rate, _ = weighted_rate(signal, seen, t, *_noise(signal, seen, t))
    lost = ~seen.any(axis=0)
    top = first.full_scale if np.isinf(most) else most
    below = np.inf if np.isinf(most) else np.nextafter(np.float32(top), np.float32(0))
    pixels = np.where(lost, top, np.minimum((common or 0.0) + rate * t[0], below))
    dead = np.any([one.dead for one in images if one.dead is not None], axis=0)
    return replace(
        first,
        pixels=pixels.astype(np.float32),
        name=" + ".join(one.name for one in images),
        black_level=common,
        saturation=None if np.isinf(most) else top,
        exposure=float(t[0]),
        dead=dead if np.ndim(dead) else None,
    )


def _levels(
    given: Sequence[Raw | float | int | None], counts: np.ndarray, seen: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray | float, float | None]:
    """Level of each pixel of each exposure, and the one of the merged image, counts."""
    known = [one.pixels.astype(float) if isinstance(one, Raw) else one for one in given]
    if all(one is not None for one in known):
        level = np.stack([np.broadcast_to(np.asarray(one), counts.shape[1:]) for one in known])
        return level, float(np.mean(level[0]))
    enough = [n for n in range(1, len(t)) if seen[n].sum() >= _FEW and t[n] > 1.05 * t[0]]
    if not enough:
        return 0.0, None
    both, ratio = seen[0] & seen[enough[-1]], t[enough[-1]] / t[0]
    far, near = (float(counts[n][both].mean()) for n in (enough[-1], 0))
    level = max((ratio * near - far) / (ratio - 1), 0.0)
    return level, level


def _noise(signal: np.ndarray, seen: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    """Gain, counts per electron, and read variance, from differences of two exposures.

    y_j − ρ y_i has the variance g r t_j (1 + ρ) + s² (1 + ρ²); s by the darker half.
    """
    gains, reads = [0.0], [_ROUNDING]
    for i in range(len(t) - 1):
        both, ratio = seen[i] & seen[i + 1], t[i + 1] / t[i]
        if both.sum() < _FEW:
            continue
        near, far = signal[i][both], signal[i + 1][both]
        squares, light = (far - ratio * near) ** 2, np.maximum(far, 0)
        dim = light <= np.median(light)
        reads.append(float(np.median(squares[dim])) / 0.455 / (1 + ratio**2))
        excess = (squares - reads[-1] * (1 + ratio**2)).sum()
        gains.append(max(float(excess / max(light.sum() * (1 + ratio), 1e-30)), 0.0))
    return float(np.median(gains[1:] or gains)), max(float(np.median(reads[1:] or reads)), 1e-12)


def _check(images: Sequence[Raw], signal: np.ndarray, seen: np.ndarray, t: np.ndarray) -> None:
    """Refuse neighbouring exposures that contradict their times, where their light shows it."""
    size = (_BLUR, _BLUR, *[1] * (signal.ndim - 3))
    for i in range(len(t) - 1):
        near, far = (scipy.ndimage.uniform_filter(signal[n], size) for n in (i, i + 1))
        both = scipy.ndimage.minimum_filter(seen[i] & seen[i + 1], size)
        if both.sum() < _FEW:
            continue
        near, far, ratio = near[both], far[both], t[i + 1] / t[i]
        # Noise of the blurred shorter one, by what its neighbours differ.
        noise = float(np.median(np.abs(np.diff(signal[i], axis=1)))) / _BLUR
        if near.std() < 8 * noise:
            continue
        names = f"{images[i + 1].name} and {images[i].name}"
        if not np.corrcoef(near, far)[0, 1] > _ALIKE:
            raise MeasurementError(
                f"{names} show different things; only exposures of one are merged, captures of "
                "several scenes are given as a folder"
            )
        found = float(far.std() / near.std())
        if abs(found / ratio - 1) > _WRONG:
            raise MeasurementError(
                f"{names} differ in brightness by a factor of {found:.3g}, and their times "
                f"{t[i + 1]:g} s and {t[i]:g} s by {ratio:.3g}; give the right `exposure` of each, "
                "and images that are linear"
            )
