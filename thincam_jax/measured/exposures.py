r"""One linear image of frames at several exposures, with the variance of each pixel.

A pixel of rate r, counts per second, has at the exposure :math:`t_i` the mean :math:`y_i` of
:math:`n_i` frames minus that of :math:`m_i` dark frames. With g counts per electron and the
variance :math:`s_i^2` of a dark frame,

.. math::
    \mathrm{E}\,y_i = r t_i, \qquad
    \mathrm{Var}\,y_i = \frac{g r t_i + s_i^2}{n_i} + \frac{s_i^2}{m_i}

and least squares through the origin with the weights :math:`w_i = 1/\mathrm{Var}\,y_i` give

.. math::
    \hat r = \frac{\sum_i w_i t_i y_i}{\sum_i w_i t_i^2}, \qquad
    \mathrm{Var}\,\hat r = \frac{1}{\sum_i w_i t_i^2}

The weights take r from :math:`\sum_i n_i y_i / \sum_i n_i t_i`, the estimate for photon noise
alone, not from each frame's own counts, which would favour the darker ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Real

from thincam_jax._core.arguments import checked

_ROUNDING = 1 / 12  # variance of whole counts


@checked
@dataclass(frozen=True, eq=False)
class ExposedFrames:
    """Frames (frame, y, x) of one `exposure`, s, in counts, and dark frames of the same exposure.

    **Errors**: ValueError for fewer than two of either, which show no noise, and other shapes.
    """

    exposure: float
    frames: Real[np.ndarray, "frame y x"]
    dark: Real[np.ndarray, "dark y x"]

    def __post_init__(self):
        if not self.exposure > 0:
            raise ValueError(f"exposure = {self.exposure} s; give more than 0")
        for name in ("frames", "dark"):
            if len(getattr(self, name)) < 2:
                raise ValueError(
                    f"{name}: {len(getattr(self, name))} at {self.exposure:g} s; give 2 or more"
                )
        if self.frames.shape[1:] != self.dark.shape[1:]:
            raise ValueError(
                f"frames of {self.frames.shape[1:]} pixels and dark frames of "
                f"{self.dark.shape[1:]}; give equal shapes"
            )


@dataclass(frozen=True, eq=False)
class MergedExposures:
    """Result of `merge_exposures`.

    - `rate`, `noise_variance`: a pixel's signal, counts/s, and its variance, (counts/s)², infinite
      where every exposure is saturated; the rate is then a lower bound, a full pixel's.
    - `gain`: g, counts per electron. `dark_variance`: s² of each exposure, counts².
    """

    rate: Float[np.ndarray, "y x"]
    noise_variance: Float[np.ndarray, "y x"]
    gain: float
    dark_variance: tuple[float, ...]

    @property
    def valid(self) -> Bool[np.ndarray, "y x"]:
        """Pixels that some exposure did not saturate."""
        return np.isfinite(self.noise_variance)


@checked
def merge_exposures(exposures: Sequence[ExposedFrames], full_scale: int = 4095) -> MergedExposures:
    """Merge frames of several exposures to one linear image, counts per second.

    - `full_scale`: largest count. An exposure is left out of a pixel where any of its frames has
      it.

    Gain and dark variance are estimated from the scatter among the frames, over all pixels. Those
    within one standard deviation of full scale, where chance
    decides what is left out, are up to 0.4 standard deviations too dark.

    **Errors**: ValueError for no exposures, and frames of other pixels.

    >>> random = np.random.default_rng(0)
    >>> scene = np.geomspace(50, 60_000, 240).reshape(12, 20)  # counts/s
    >>> def taken(exposure):
    ...     light = random.poisson(scene * exposure, (4, 12, 20))
    ...     noise = random.normal(60, 3, (8, 12, 20))
    ...     frames = np.clip(np.rint(light + noise[:4]), 0, 4095)
    ...     return ExposedFrames(exposure, frames, np.rint(noise[4:]))
    >>> merged = merge_exposures([taken(0.05), taken(1.0)])
    >>> bool(np.all(np.abs(merged.rate - scene) < 5 * np.sqrt(merged.noise_variance)))
    True
    """
    if not exposures:
        raise ValueError("there are no exposures; give one or more")
    shapes = {one.frames.shape[1:] for one in exposures}
    if len(shapes) > 1:
        raise ValueError(f"frames of the pixels {shapes}; give equal shapes")
    times = np.array([one.exposure for one in exposures])
    counts, darks = np.transpose([(len(one.frames), len(one.dark)) for one in exposures])
    maps = np.swapaxes([moments(one, full_scale) for one in exposures], 0, 1)
    means, scatter, dark_variance, seen = maps[0], maps[1], maps[3].mean(axis=(1, 2)), maps[4] > 0
    read = np.maximum(dark_variance, _ROUNDING)
    # Photon noise over signal, mostly of the brightest pixels: the noise of dark ones has no say.
    excess = scatter - read[:, None, None]
    light = float(np.sum(means[seen] ** 2))
    gain = max(float(np.vdot(means[seen], excess[seen])) / light, 0.0) if light > 0 else 0.0

    def along(numbers: np.ndarray) -> np.ndarray:
        return np.where(seen, numbers[:, None, None], 0.0)

    rough = (along(counts) * means).sum(axis=0) / np.maximum(
        along(counts * times).sum(axis=0), 1e-300
    )
    expected = gain * np.maximum(rough, 0.0) * times[:, None, None]
    noise = expected / counts[:, None, None] + (read * (1 / counts + 1 / darks))[:, None, None]
    weights = seen / noise
    information = (weights * along(times) ** 2).sum(axis=0)
    valid = information > 0
    shortest = int(np.argmin(times))
    full = means[shortest] / times[shortest]
    rate = (weights * along(times) * means).sum(axis=0) / np.where(valid, information, 1.0)
    variance = np.where(valid, 1 / np.where(valid, information, 1.0), np.inf)
    return MergedExposures(
        np.where(valid, rate, full), variance, gain, tuple(dark_variance.tolist())
    )


def moments(one: ExposedFrames, full_scale: int, lines: bool = False) -> np.ndarray:
    """Maps of the light's mean and variance, of the dark's, and where no frame is full."""
    seen = one.frames.max(axis=0) < full_scale
    counted = seen if seen.any() else ~seen
    dark = one.dark.mean(axis=0, dtype=float)
    light = one.frames.mean(axis=0, dtype=float) - dark
    # A lamp's flicker changes all pixels in proportion to their light, and is no noise.
    lit = variance(one.frames, light / (light.mean(where=counted) or 1.0), counted, lines)
    return np.stack(
        [light, lit, dark, variance(one.dark, np.ones_like(dark), counted, lines), seen]
    )


def variance(frames: np.ndarray, profile: np.ndarray, seen: np.ndarray, lines: bool) -> np.ndarray:
    """Unbiased, among frames, without a common change by a profile and what `lines` share."""
    mean, squares = frames.mean(axis=0, dtype=float), np.zeros_like(profile)
    for frame in frames:
        rest = frame - mean - (frame - mean).mean(where=seen) * profile
        if lines:
            rest += rest.mean() - rest.mean(axis=1, keepdims=True) - rest.mean(axis=0)
        squares += rest**2
    left = np.prod(1 - 1 / np.array(profile.shape)) if lines else 1.0
    return squares / (len(frames) - 1) / left
