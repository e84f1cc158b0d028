r"""Calibration of a sensor: dark level, response, noise and defective pixels.

A pixel with the dark level b at the exposure :math:`t_0`, to which each second adds r counts, and
of response f, 1 in the mean, has at the exposure t and for light of u counts

.. math::
    \mathrm{E}\,y = b + r (t - t_0) + f u, \qquad
    \mathrm{Var}\,y = K^2 \sigma_d^2 + \tfrac{1}{12} + K (\mathrm{E}\,y - b + r t_0)

with K counts per electron, the read noise :math:`\sigma_d` in electrons, and 1/12 for whole counts.
The electrons of light and of dark current are Poisson numbers. So the variance grows with the mean,
and K is the slope: the photon transfer method (EMVA 1288, release 3.1, equation 9).
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
from thincam_jax._core.text import of_error
from thincam_jax.measured.exposures import ExposedFrames, moments
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
    - `photon_transfer`: of each level, mean light, counts, additional variance and its error.
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

    def __post_init__(self):
        maps = [one for one in vars(self).values() if np.ndim(one) == 2]
        shapes = {one.shape for one in maps} - {self.photon_transfer.shape}
        lit = len(shapes) == 1 and bool(np.all((self.response > 0) | self.defective))
        if not (lit and min(self.exposure, self.conversion_gain) > 0):
            raise MeasurementError(f"maps of {shapes}, no gain or no response; measure it again")

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
        variance = photons + (gain * self.read_noise) ** 2 + _ROUNDING + self.dark_level_error**2
        variance += (light * self.response_error * per_response) ** 2
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
def measure_sensor(
    series: Sequence[ExposedFrames],
    full_scale: int = 4095,
    *,
    outlier: float = 6.0,
    mosaic: bool = False,
) -> SensorCalibration:
    r"""Measure a sensor with frames of an evenly lit surface and dark frames.

    - `series`: exposures, as `Acquisition.exposed` reads them; several show the dark current.
    - `outlier`: difference from the neighbours, in standard deviations, of a defective pixel.
    - `mosaic`: of a Bayer pattern: the mean response is 1 at each of its four places, so that the
      colour of the light has no effect.

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
    maps = np.swapaxes([moments(one, full_scale) for one in series], 0, 1)
    light, variance, dark, dark_variance, seen = maps
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
    parts = *(line**2 / darks), counted  # of the variance of a frame
    for values, part in zip((level, rate, total), parts, strict=True):
        odd |= _stands_out(values, outlier, float(np.sqrt(least * part.sum())))
    high, half = scipy.special.chdtri(degrees.sum(), [scipy.special.ndtr(-outlier), 0.5])
    odd |= noise > least * high / half
    good, scale = ~odd, np.ones_like(total)
    for place in _PLACES if mosaic else (np.s_[:, :],):
        scale[place] = total[place][good[place]].sum() / max(good[place].sum(), 1)
    if not (scale > 0).all():
        raise MeasurementError("the frames are no brighter than the dark ones; give more light")

    excess = (variance - dark_variance)[used][:, good]
    gain, in_gain, points = _photon_transfer(light[used][:, good], excess)
    # What each pixel adds to the errors: of the read noise's variance, then of it in electrons.
    current = rate[good] * (degrees @ times / degrees.sum())
    read = noise[good] - gain * current - _ROUNDING
    in_read = (read - read.mean()) / read.size - current.mean() * in_gain
    deviation = np.sqrt(max(read.mean(), np.linalg.norm(in_read)))
    in_electrons = in_read / (2 * deviation * gain) - deviation / gain**2 * in_gain

    constant = max(float(read.mean()), 0.0) + _ROUNDING
    of_dark = np.maximum(constant + gain * np.multiply.outer(times, rate), _ROUNDING)
    of_light = np.maximum(of_dark + gain * light, _ROUNDING)
    of_light += of_dark * (frames / darks)[:, None, None]
    variances = *np.tensordot(line**2 / darks, of_dark, 1), np.tensordot(counted, of_light, 1)
    errors = np.sqrt(np.stack(variances, dtype=np.float32))
    maps = level, errors[0], rate, errors[1], good * total / scale, good * errors[2] / scale
    found = np.sqrt(max(read.mean(), 0.0)) / gain, np.linalg.norm(in_electrons)
    numbers = map(float, (gain, np.linalg.norm(in_gain), *found))
    single = [one.astype(np.float32) for one in maps]
    every: list[Any] = [middle, *single, odd, *numbers, full_scale, points]
    return SensorCalibration(*every)


def _photon_transfer(light: np.ndarray, excess: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """K, what each pixel adds to its error, and the line's points, of maps (level, pixel)."""
    means, averages = light.mean(axis=1), excess.mean(axis=1)
    scatter = (excess - averages.sum() / means.sum() * light).var(axis=1)
    weights = means / np.maximum(scatter, _ROUNDING)
    gain = float(weights @ averages / (weights @ means))
    in_gain = weights @ (excess - gain * light) / (weights @ means) / light.shape[1]
    if not gain > 4 * np.linalg.norm(in_gain):
        raise MeasurementError("the variance does not grow with the light; give raw frames")
    points = means, averages, np.sqrt(scatter / light.shape[1])
    return gain, in_gain, np.stack(points, axis=1)


def _stands_out(values: np.ndarray, outlier: float, error: float) -> np.ndarray:
    """Pixels unlike the median of their 5×5 neighbours of one colour; `error`: least deviation."""
    found = np.zeros(values.shape, bool)
    for place in _PLACES:
        difference = np.abs(values[place] - scipy.ndimage.median_filter(values[place], 5))
        found[place] = difference > outlier * max(1.4826 * float(np.median(difference)), error)
    return found
