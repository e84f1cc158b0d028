r"""Calibration of a sensor: dark level, response, noise and defective pixels.

A pixel with the dark level b at the exposure :math:`t_0`, to which each second adds r counts, and
of response f, 1 in the mean, has at the exposure t and for light of u counts

.. math::
    \mathrm{E}\,y = b + r (t - t_0) + f u, \qquad
    \mathrm{Var}\,y = K^2 \sigma_d^2 + \tfrac{1}{12} + K (\mathrm{E}\,y - b + r t_0)

with K counts per electron, the read noise :math:`\sigma_d` in electrons, and 1/12 for whole counts.
The electrons of light and of dark current are Poisson numbers. So the variance grows with the mean,
and K is the slope: the photon transfer method (EMVA 1288, release 3.1, equation 9).

Whole counts add 1/12 to noise s of half a count or more. For means anywhere between counts, their
squared biases, :math:`\sum_k e^{-(2\pi s k)^2}/2\pi^2k^2`, are taken off it (Widrow and Kollár,
Quantization Noise, 2008). A response u (1 − a u) makes V = K Y (1 − 3 a Y).
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.files import MeasurementError, read_arrays, write_whole
from thincam_jax._core.progress import watched
from thincam_jax._core.text import of_error
from thincam_jax.measured.exposures import ExposedFrames, moments, variance
from thincam_jax.measured.raw import Raw

_ROUNDING = 1 / 12  # variance of whole counts
_FEW = 0.01  # share of the pixels that may be brighter, and of dark counts that may be 0
_PLACES = tuple(np.s_[i::2, j::2] for i in (0, 1) for j in (0, 1))  # of a Bayer pattern


@checked
@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """A sensor's dark level, response and noise, as `measure_sensor` finds them.

    - `exposure`: s, of the frames that it corrects; see `at`.
    - `dark_level`, `dark_rate`: b, counts; r, counts/s, without error where all dark frames have
      one exposure. `response`: f, 0 in defective pixels.
    - `defective`: pixels that are hot, dead, or unlike their neighbours in level or noise.
    - `conversion_gain`: K, counts per electron. `read_noise`: in electrons; without a rate, with
      that of the dark current.
    - `photon_transfer`: mean light, counts, additional variance and its error at each level.
    - `line_noise`: noise of rows and columns, electrons, beside the read noise. `bend`: change of
      V/Y up to the brightest level, relative. Both 0 if not seen.
    - `_error`: standard error. All hold for one gain, black level, format, binning and region.
    """

    exposure: float
    dark_level: Float[np.ndarray, "y x"]
    dark_level_error: Float[np.ndarray, "y x"]
    dark_rate: Float[np.ndarray, "y x"]
    dark_rate_error: Float[np.ndarray, "y x"]
    response: Float[np.ndarray, "y x"]
    response_error: Float[np.ndarray, "y x"]
    defective: Bool[np.ndarray, "y x"]
    conversion_gain: float
    conversion_gain_error: float
    read_noise: float
    read_noise_error: float
    full_scale: int
    photon_transfer: Float[np.ndarray, "level 3"]
    line_noise: float = 0.0
    bend: float = 0.0

    def __post_init__(self):
        maps = [one for one in vars(self).values() if np.ndim(one) == 2]
        shapes = {one.shape for one in maps} - {self.photon_transfer.shape}
        lit = len(shapes) == 1 and bool(np.all((self.response > 0) | self.defective))
        if not (lit and min(self.exposure, self.conversion_gain) > 0):
            raise MeasurementError(f"maps of {shapes}, no gain or no response; measure it again")

    @property
    def findings(self) -> tuple[str, ...]:
        """Findings that contradict the errors or that frames cannot show, and what to do."""
        levels, most = len(self.photon_transfer), 0.5 / self.conversion_gain
        flat = self.read_noise < most and self.dark_level[~self.defective].std() < 0.55
        found = {
            f"rounding may hide a read noise of up to {most:.3g} electrons, as all dark levels are "
            "alike; raise the analogue gain": flat,
            "the read noise has that of the dark current in it; take dark frames of a second "
            "exposure": not self.dark_rate_error.any(),
            f"{levels} usable exposures do not show whether the sensor is linear, as the errors "
            "suppose; take three or more": levels < 3,
            f"the response is not linear: bright light is off by some {abs(self.bend) / 3:.1%}, "
            "and the gain is that of faint light; expose less": self.bend != 0 and not flat,
        }
        return tuple(text for text, holds in found.items() if holds)

    def at(self, exposure: float) -> "SensorCalibration":
        """Calibration for frames of another exposure, s; MeasurementError without a dark rate."""
        later = exposure - self.exposure
        if not self.dark_rate_error.any() and abs(later) > 1e-3 * self.exposure:
            raise MeasurementError(
                f"all dark frames have {self.exposure:g} s and the frame has {exposure:g} s; "
                "measure the sensor with dark frames of a second exposure"
            )
        error = np.hypot(self.dark_level_error, self.dark_rate_error * later)
        level = self.dark_level + self.dark_rate * later
        return replace(self, exposure=exposure, dark_level=level, dark_level_error=error)

    def correct(self, raw: Raw) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]]:
        """Light u of a frame, counts, and its variance; both 0 in defective pixels.

        The variance is that of photon noise, by the pixel's own count, read noise and calibration.
        """
        known, given = (self.response.shape, self.full_scale), (raw.pixels.shape, raw.full_scale)
        if known != given:
            raise MeasurementError(
                f"the sensor was measured with (pixels, full scale) {known}, and {raw.name} has "
                f"{given}; give frames of the same region, binning and pixel format, and `bits`"
            )
        light, gain = raw.pixels - self.dark_level, self.conversion_gain
        per_response = np.where(self.defective, 0, 1 / np.where(self.defective, 1, self.response))
        photons = gain * np.maximum(light + self.dark_rate * self.exposure, 0)
        variance = photons + gain**2 * (self.read_noise**2 + self.line_noise**2) + _ROUNDING
        variance += self.dark_level_error**2 + (light * self.response_error * per_response) ** 2
        return light * per_response, variance * per_response**2

    def save(self, path: str | Path) -> Path:
        """Write it to one file, .npz."""
        file = io.BytesIO()
        np.savez(file, **vars(self))
        return write_whole(path, file.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> "SensorCalibration":
        """Read what `save` has written; MeasurementError, one line, for any other file."""
        try:
            found: Any = read_arrays(path)
            return cls(**{name: one if one.ndim else one.item() for name, one in found.items()})
        except OSError:
            raise
        except Exception as error:  # of many kinds, as NumPy takes the headers for Python
            cause = f"{path} is no calibration of a sensor ({of_error(error)})"
            raise MeasurementError(f"{cause}; measure it again and save it so") from error


@checked
@watched("measuring the sensor")
def measure_sensor(
    series: Sequence[ExposedFrames],
    *,
    full_scale: int = 4095,
    outlier: float = 6.0,
    mosaic: bool = False,
) -> SensorCalibration:
    r"""Measure a sensor with frames of an evenly lit surface and dark frames.

    - `series`: exposures, as `Acquisition.exposed` reads them; several show the dark current.
    - `outlier`: difference from the neighbours, in standard deviations, of a defective pixel.
    - `mosaic`: whether the sensor has a Bayer pattern: the mean response is 1 at each of its four
      places, so that the colour of the light has no effect.

    With the means :math:`Y_j` of light over all good pixels, and :math:`V_j` of the variance of lit
    minus that of dark frames, :math:`K = \sum_j w_j V_j / \sum_j w_j Y_j`, unbiased for any
    weights; the scatter over the pixels gives the errors. Exposures at which over 1 % of the pixels
    exceed 0.8 of full scale are used for the dark level only. Unevenness of the light counts as
    response. MeasurementError for frames that do not fit together, are too bright, or too dark.

    >>> random = np.random.default_rng(0)
    >>> def taken(exposure):
    ...     light = 0.5 * random.poisson(2e4 * exposure, (8, 40, 60))
    ...     noise = random.normal(60, 3, (16, 40, 60))
    ...     return ExposedFrames(exposure, np.rint(light + noise[:8]), np.rint(noise[8:]))
    >>> sensor = measure_sensor([taken(0.05), taken(0.2)])
    >>> bool(abs(sensor.conversion_gain - 0.5) < 4 * sensor.conversion_gain_error)
    True
    """
    if not series or len({one.frames.shape[1:] for one in series}) > 1:
        raise MeasurementError("give one exposure or more, all with frames of the same pixels")
    if max(np.mean(one.dark == 0) for one in series) > _FEW:
        raise MeasurementError("dark counts of 0 hide their noise; raise the camera's black level")
    times = np.array([one.exposure for one in series])
    frames, darks = np.transpose([(len(one.frames), len(one.dark)) for one in series])
    maps = np.array([moments(one, full_scale) for one in series])
    whole = np.ones(maps.shape[-2:], bool)
    free = np.array([variance(one.dark, 1.0 * whole, whole, lines=True) for one in series])
    # What rows and columns share among dark frames, and its deviation if they share nothing.
    shared = (darks - 1) @ (maps[:, 3] - free).mean(axis=(1, 2)) / (darks - 1).sum()
    chance = 2 * sum(1 / n for n in whole.shape) * np.mean(free**2) / whole.size
    lines = float(shared) if shared > 5 * np.sqrt(chance / (darks - 1).sum()) else 0.0
    if lines:
        maps = np.array([moments(one, full_scale, lines=True) for one in series])
    light, lit_variance, dark, dark_variance, seen = np.swapaxes(maps, 0, 1)
    used = np.mean(light + dark > 0.8 * full_scale, axis=(1, 2)) <= _FEW
    if not used.any():
        raise MeasurementError("the light is over 0.8 of full scale; give a shorter exposure")
    # Weights of the dark means that give the line of each pixel, and of the variances.
    middle, degrees = float(darks @ times / darks.sum()), darks - 1
    moment = darks * (times - middle)
    spread = moment @ times if np.ptp(times) > 1e-3 * middle else np.inf
    line = np.stack([darks / darks.sum(), moment / spread])
    level, rate = np.tensordot(line, dark, 1)
    noise = np.tensordot(degrees / degrees.sum(), dark_variance, 1)
    total = np.tensordot(counted := used * frames, light, 1)

    odd = ~(seen[used].all(axis=0) & (total > 0))
    least = max(float(np.median(noise)), _ROUNDING)
    # Rounding's biases of the means, squared, and the most that it makes of a pixel's variance.
    true = float(_unrounded(rounded := np.mean(noise[noise <= 4 * least]))[0])
    bias = max(true + _ROUNDING - rounded, 0.0)
    parts = *(line**2 / darks), counted  # of the variance of a frame
    biases = [bias * np.abs(one).sum() ** 2 for one in (*line, counted)]
    for values, part, one in zip((level, rate, total), parts, biases, strict=True):
        odd |= _stands_out(values, outlier, float(np.sqrt((least + lines) * part.sum() + one)))
    high, half = scipy.special.chdtri(degrees.sum(), [scipy.special.ndtr(-outlier), 0.5])
    odd |= noise > max(least, (true < 0.25) * (true + 0.25)) * high / half
    good, scale = ~odd, np.ones_like(total)
    for place in _PLACES if mosaic else (np.s_[:, :],):
        scale[place] = total[place][good[place]].sum() / max(good[place].sum(), 1)
    if not (scale > 0).all():
        raise MeasurementError("the frames are no brighter than the dark ones; give more light")

    dark_variance = dark_variance[:, good]
    unrounded, slopes = _unrounded(dark_variance.mean(axis=1))
    lit = lit_variance[used][:, good]
    excess = lit + (_unrounded(averages := lit.mean(axis=1))[0] - averages)[:, None]
    excess -= dark_variance[used] + (unrounded - dark_variance.mean(axis=1))[used][:, None]
    light = light[used][:, good]
    levels = [series[i] for i in np.where(used)[0]]
    bent = len(levels) > 2 and _is_bent(levels, light.mean(axis=1), good)
    gain, in_gain, points, bend = _photon_transfer(light, excess, bent)
    # What each pixel adds to the errors: of the read noise's variance, then of it in electrons.
    current = rate[good] * (degrees @ times / degrees.sum())
    read = (degrees * slopes) @ dark_variance / degrees.sum() - gain * current
    in_read = (read - read.mean()) / read.size - current.mean() * in_gain
    found = max(float(degrees @ unrounded / degrees.sum() - gain * current.mean()), 0.0)
    deviation = np.sqrt(max(found, np.linalg.norm(in_read), 1e-12))
    in_electrons = in_read / (2 * deviation * gain) - deviation / gain**2 * in_gain

    constant = found + lines + _ROUNDING
    of_dark = np.maximum(constant + gain * np.multiply.outer(times, rate), _ROUNDING)
    of_light = np.maximum(of_dark + gain * maps[:, 0], _ROUNDING)
    of_light += of_dark * (frames / darks)[:, None, None]
    variances = *np.tensordot(line**2 / darks, of_dark, 1), np.tensordot(counted, of_light, 1)
    errors = np.sqrt(np.stack(variances, dtype=np.float32) + np.reshape(biases, (3, 1, 1)))
    maps = level, errors[0], rate, errors[1], good * total / scale, good * errors[2] / scale
    of_read = np.sqrt(found) / gain, np.linalg.norm(in_electrons)
    numbers = map(float, (gain, np.linalg.norm(in_gain), *of_read))
    single = [one.astype(np.float32) for one in maps]
    every: list[Any] = [middle, *single, odd, *numbers, full_scale, points]
    return SensorCalibration(*every, line_noise=float(np.sqrt(lines) / gain), bend=bend)


def _unrounded(variance: Any) -> tuple[np.ndarray, np.ndarray]:
    """s² of the variance in whole counts, and its derivative."""
    s, k = np.linspace(0, 1, 201), np.arange(1, 1000)[:, None]
    biases = (np.exp(-((2 * np.pi * s * k) ** 2)) / (2 * np.pi**2 * k**2)).sum(axis=0)
    whole = s**2 + biases[0] - biases
    below = np.interp(variance, whole, s**2)
    found = np.where(variance < whole[-1], below, variance - _ROUNDING)
    slope = np.asarray(np.interp(variance, whole, np.gradient(s**2, whole), right=1.0))
    return np.asarray(found), slope


def _is_bent(series: Sequence[ExposedFrames], means: np.ndarray, good: np.ndarray) -> bool:
    """Whether light per second changes with the light by more than its scatter among frames."""
    times, counts = np.array([(one.exposure, len(one.frames)) for one in series]).T
    lit, dark = np.array(
        [[f.mean((1, 2), where=good).var(ddof=1) for f in (o.frames, o.dark)] for o in series]
    ).T
    degrees, offset = counts - 1, dark / [len(one.dark) for one in series] + 1 / good.sum()
    error = np.sqrt(degrees @ (lit / means**2) / degrees.sum() / counts + offset / means**2)
    rate = means / times / np.average(means / times, weights=error**-2)
    (slope, _), spread = np.polyfit(means, rate, 1, w=1 / error, cov="unscaled")
    return bool(abs(slope) > scipy.special.stdtrit(degrees.sum(), 0.9995) * spread[0, 0] ** 0.5)


def _photon_transfer(light: np.ndarray, excess: np.ndarray, bent: bool) -> tuple[Any, ...]:
    """K, what each pixel adds to its error, the line's points and bend, of maps (level, pixel)."""
    means, averages = light.mean(axis=1), excess.mean(axis=1)
    scatter = (excess - averages.sum() / means.sum() * light).var(axis=1)
    weights = means / np.maximum(scatter, _ROUNDING)
    gain = float(weights @ averages / (weights @ means))
    in_gain = weights @ (excess - gain * light) / (weights @ means) / light.shape[1]
    if not gain > 4 * np.linalg.norm(in_gain):
        raise MeasurementError("the variance does not grow with the light; give raw frames")
    points = np.stack([means, averages, np.sqrt(scatter / light.shape[1])], axis=1)
    powers = np.stack([light, light**2])
    solve = np.linalg.pinv(powers.mean(axis=2).T / points[:, 2:]) / points[:, 2]
    both = solve @ averages
    in_both = solve @ (excess - np.tensordot(both, powers, 1)) / light.shape[1]
    if len(means) < 3 or not (bent or abs(both[1]) > 3 * np.linalg.norm(in_both[1])):
        return gain, in_gain, points, 0.0
    return float(both[0]), in_both[0], points, float(both[1] * means.max() / both[0])


def _stands_out(values: np.ndarray, outlier: float, error: float) -> np.ndarray:
    """Pixels unlike the median of their 5×5 neighbours of one colour; `error`: least deviation."""
    found = np.zeros(values.shape, bool)
    for place in _PLACES:
        difference = np.abs(values[place] - scipy.ndimage.median_filter(values[place], 5))
        found[place] = difference > outlier * max(1.4826 * float(np.median(difference)), error)
    return found
