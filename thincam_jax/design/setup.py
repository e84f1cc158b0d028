"""Setup that a design is evaluated in: sensor, noise, the scene's spectrum and frequencies.

Angular frequencies ν, in cycles/rad, belong to the object and are the same for captures at every
distance d: on a sensor at d they are ν/d cycles/mm.
"""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.polynomial.legendre import leggauss

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, quantity


@checked
class PowerLaw(Module):
    r"""Spectral density :math:`\propto (\nu^2 + \nu_0^2)^{-\gamma/2}`, ν in cycles/rad.

    γ = 2 is the 1/f² of the reconstruction's prior (`thincam_jax.reconstruct`), with as much
    variance in each octave; photographs fall off faster (`fit_power_law`).

    - `exponent`: γ ≥ 0.
    - `corner`: ν₀, cycles/rad; default one cycle over the object.
    """

    exponent: Float[Array, ""] = eqx.field(
        default=2.0, converter=quantity("powers of the frequency", non_negative=True)
    )
    corner: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity("cycles/rad", positive=True, optional=True)
    )

    def __call__(
        self, frequency_squared: Float[Array, "*shape"], field: Float[Array, ""]
    ) -> Float[Array, "*shape"]:
        """The density up to a factor; `field` is the object's width in rad."""
        corner = 1 / field if self.corner is None else self.corner
        # Relative to the corner: powers of large numbers would overflow float32.
        return (frequency_squared / corner**2 + 1) ** (-self.exponent / 2)


@checked
def fit_power_law(images: Iterable[Float[np.ndarray, "y x"]]) -> PowerLaw:
    """The exponent that fits the spectra of photographs best, corner at one cycle a picture.

    A straight line through the mean logarithm of the power in rings from 4 cycles a picture to half
    of the Nyquist frequency, under a Hann window against the steps at the borders.
    """
    slopes = [_slope(np.asarray(image, dtype=float)) for image in images]
    if not slopes:
        raise ValueError("no images; give at least one to fit a spectrum to")
    return PowerLaw(float(max(0.0, -np.mean(slopes))))


def _slope(image: np.ndarray) -> float:
    """d log power / d log frequency of one picture."""
    if image.ndim != 2 or min(image.shape) < 32:
        raise ValueError(f"an image has shape {image.shape}; give (y, x) of at least 32 pixels")
    if not np.ptp(image) > 0:
        raise ValueError("an image has no contrast; its spectrum has no slope")
    window = np.outer(*(np.hanning(n) for n in image.shape))
    mean = np.sum(window * image) / np.sum(window)
    power = np.abs(np.fft.fft2(window * (image - mean))) ** 2
    v, u = (np.fft.fftfreq(n) for n in image.shape)
    frequency = np.hypot(v[:, None], u)
    edges = np.geomspace(4 / min(image.shape), 0.25, 13)
    ring = np.digitize(frequency, edges)
    rings = [r for r in range(1, len(edges)) if np.any(ring == r)]
    level = [np.log(np.mean(power[ring == r]) + np.finfo(float).tiny) for r in rings]
    place = [np.log(np.mean(frequency[ring == r])) for r in rings]
    return float(np.polyfit(place, level, 1)[0])


class SignalNoise(Module):
    """Gaussian noise at a signal-to-noise ratio, whatever the light.

    - `snr_db`: ratio of the capture's variance over the sensor to the noise's, dB. Dividing the
      exposure among captures does not change it.
    """

    snr_db: Float[Array, ""] = eqx.field(
        default=30.0, converter=quantity("dB", check=checks.decibels)
    )

    def variance(self, light: Numbers, signal: Numbers, exposure: Numbers):
        """Noise variance of a pixel, mm⁴, from a capture's mean (mm²), variance and exposure."""
        return signal * 10 ** (-self.snr_db / 10)


class PhotonNoise(Module):
    """Shot noise of the design's own light, and read noise.

    - `electrons`: electrons of a pixel, from each mm² of open aperture, in an exposure of one share
      (`Design.exposure`): what the mask lets through is the design's own.
    - `read_noise`: standard deviation, electrons, of each capture.
    """

    electrons: Float[Array, ""] = eqx.field(
        default=2_000.0, converter=quantity("electrons/mm^2", positive=True)
    )
    read_noise: Float[Array, ""] = eqx.field(
        default=8.0, converter=quantity("electrons", non_negative=True)
    )

    def variance(self, light: Numbers, signal: Numbers, exposure: Numbers):
        """Noise variance of a pixel, mm⁴, from a capture's mean (mm²), variance and exposure."""
        counted = self.electrons * exposure
        return light / counted + (self.read_noise / counted) ** 2


def _noise(given: SignalNoise | PhotonNoise | None) -> SignalNoise | PhotonNoise:
    return SignalNoise() if given is None else given


def _prior(given: PowerLaw | None) -> PowerLaw:
    return PowerLaw() if given is None else given


# Pixels along a sensor, and an object's width over its distance: what must be m or µm is refused.
_MOST_PIXELS, _WIDEST = 1e5, 100.0


@checked
class Setup(Module):
    """A sensor before a scene of mean 1 and the variance `contrast`².

    - `pitch`: side of the sensor's pixels, mm; `sensor_width`: mm.
    - `object_distance`: t, mm; `object_width`: mm.
    - `noise`: `SignalNoise` or `PhotonNoise`.
    - `prior`: the scene's spectrum.
    - `contrast`: standard deviation of the scene over its mean.
    - `pixel_integration`: average over the pixels' area.
    - `crop`: count what the sensor does not see of an object's shadow; see
      `thincam_jax.design.response`.
    """

    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.pixel_pitch))
    sensor_width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    contrast: Float[Array, ""] = eqx.field(
        default=0.5, converter=quantity("parts of the mean", positive=True)
    )
    noise: SignalNoise | PhotonNoise = eqx.field(default=None, converter=_noise)
    prior: PowerLaw = eqx.field(default=None, converter=_prior)
    pixel_integration: bool = eqx.field(default=True, converter=bool, static=True)
    crop: bool = eqx.field(default=True, converter=bool, static=True)

    def __check_init__(self):
        if checks.holds_traced(self):
            return
        lengths = self.pitch, self.sensor_width, self.object_distance, self.object_width
        pitch, sensor, distance, across = map(float, lengths)
        if not (1.5 < sensor / pitch < _MOST_PIXELS and across / distance < _WIDEST):
            raise FieldError(
                f"sensor_width = {sensor:g} mm are {sensor / pitch:.3g} pixels, object_width = "
                f"{across:g} mm is {across / distance:.3g} times object_distance; give all in mm",
                "object_width",
            )

    @property
    def field(self) -> Float[Array, ""]:
        """Width of the object as seen from the mask, rad (small angles)."""
        return self.object_width / self.object_distance


@checked
class Quadrant(eqx.Module):
    r"""A square of frequencies ν_x, ν_y ≥ 0 that stands for the whole plane.

    The response of a centred zone aperture is even in both, so that n² samples are those of a
    (2n − 1)² image. Samples must be closer than half the inverse of the mask's width as seen from
    the sensor, d/(2·width): else the uniform background falls between them
    and its variance is missed. Where the whole band would need `even` samples and there are fewer,
    they are that close at zero only, at :math:`\nu \propto \sinh(bi)`: finer rings average out, and
    an error is off by less than 0.01 dB for 256 samples.

    - `axis`: ν from zero up, cycles/rad, along either axis.
    - `weight`: area that each point stands for, so that Σ w g is ∬ g dν_x dν_y over the plane.
    - `bend`: b (n − 1); 0 for even samples.
    """

    axis: Float[Array, " n"]
    weight: Float[Array, "n n"]
    bend: float = eqx.field(static=True)

    def __init__(self, highest: Number, count: int = 512, even: int = 0):
        """`highest`: the band's end along an axis, cycles/rad; `count`: samples along it."""
        if count < 2:
            raise ValueError(f"count = {count}: give at least 2 frequencies")
        highest = checks.positive("highest", highest, "cycles/rad")
        self.axis = highest * jnp.linspace(0.0, 1.0, count, dtype=highest.dtype)
        along = jnp.full(count, 2.0, self.axis.dtype).at[0].set(1.0)
        self.weight = along[:, None] * along * (self.axis[1] - self.axis[0]) ** 2
        self.bend = _bend((even - 1) / (count - 1))
        if self.bend:
            middles = np.minimum(np.arange(count) + 0.5, count - 1)  # no wider than the band
            cells = 2 * np.diff(_places(middles, count, self.bend), prepend=0.0)
            along = highest * jnp.asarray(cells, highest.dtype)
            self.axis = highest * jnp.asarray(self._places, highest.dtype)
            self.weight = along[:, None] * along

    @property
    def _places(self) -> np.ndarray:
        """Parts of the highest frequency."""
        count = len(self.axis)
        return _places(np.arange(count), count, self.bend)

    @property
    def squared(self) -> Float[Array, "n n"]:
        """|ν|² at each point."""
        return self.axis[:, None] ** 2 + self.axis**2

    @property
    def highest(self) -> Float[Array, ""]:
        """The end of the band, cycles/rad."""
        return self.axis[-1]

    def ring(self, rings: int) -> Int[np.ndarray, " point"]:
        """Ring of each point, of `rings` up to the highest frequency; number `rings` in corners."""
        place = self._places
        radius = np.hypot(place[:, None], place).ravel()
        return np.where(radius < 1, np.minimum(radius * rings, rings - 1), rings).astype(int)


def _places(number: np.ndarray, count: int, bend: float) -> np.ndarray:
    """Places of numbered samples, the last of `count` at 1."""
    part = number / (count - 1)
    return np.sinh(bend * part) / np.sinh(bend) if bend else part


def _bend(ratio: float) -> float:
    """b for which the mean spacing sinh(b)/b is so many times that at zero; 0 for less than 1."""
    if ratio <= 1:
        return 0.0
    bends = np.geomspace(1e-3, 50.0, 5000)
    return float(np.interp(np.log(ratio), np.log(np.sinh(bends) / bends), bends))


@checked
class Polar(eqx.Module):
    r"""Radii and directions: a response whose fringes are rings needs few directions.

    Directions are Gauss-Legendre nodes of an octant, which stands for all eight.

    - `radius`: |ν|, cycles/rad; `cosine`, `sine`: components of each direction.
    - `weight`: so that Σ w g is ∬ g dν_x dν_y over the disc.
    """

    radius: Float[Array, " n"]
    cosine: Float[Array, " m"]
    sine: Float[Array, " m"]
    weight: Float[Array, "m n"]

    def __init__(self, highest: Number, count: int = 2048, directions: int = 4):
        """`highest`: the disc's radius, cycles/rad; `count`: radii, at the middles of rings."""
        if count < 2 or directions < 1:
            raise ValueError(
                f"count = {count}, directions = {directions}: give at least 2 radii, 1 direction"
            )
        highest = checks.positive("highest", highest, "cycles/rad")
        nodes, weights = leggauss(directions)
        angle = np.pi / 8 * (nodes + 1)
        self.cosine = jnp.asarray(np.cos(angle), highest.dtype)
        self.sine = jnp.asarray(np.sin(angle), highest.dtype)
        self.radius = highest * (jnp.arange(count, dtype=highest.dtype) + 0.5) / count
        rings = 2 * jnp.pi * self.radius * (highest / count)
        self.weight = jnp.asarray(weights / 2, highest.dtype)[:, None] * rings

    @property
    def squared(self) -> Float[Array, "m n"]:
        """|ν|² at each point."""
        return jnp.broadcast_to(self.radius**2, self.weight.shape)

    @property
    def highest(self) -> Float[Array, ""]:
        """The end of the band, cycles/rad."""
        return self.radius[-1] + 0.5 * (self.radius[1] - self.radius[0])

    def ring(self, rings: int) -> Int[np.ndarray, " point"]:
        """Ring of each point, of `rings` up to the highest frequency."""
        place = (np.arange(len(self.radius)) + 0.5) / len(self.radius)
        return np.tile((place * rings).astype(int), len(self.cosine))


Frequencies = Quadrant | Polar
