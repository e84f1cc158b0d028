"""Setup that a design is evaluated in: sensor, noise, and the expected spectrum of the scene."""

from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity


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

    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
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

    @property
    def field(self) -> Float[Array, ""]:
        """Width of the object as seen from the mask, rad (small angles)."""
        return self.object_width / self.object_distance
