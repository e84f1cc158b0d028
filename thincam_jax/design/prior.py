"""What a scene is expected to hold: its power at each angular frequency."""

from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity


class PowerLaw(Module):
    r"""Spectral density :math:`\propto (\nu^2 + \nu_0^2)^{-\gamma/2}`, ν in cycles/rad.

    γ = 2 is the 1/f² of the reconstruction's prior (`thincam_jax.reconstruct`), with as much
    variance in each octave; photographs fall off faster (`fit_power_law`).

    - `exponent`: γ ≥ 0.
    - `corner`: ν₀, cycles/rad; default one cycle over the object.
    """

    exponent: Float[Array, ""] = eqx.field(
        default=2.0,
        converter=quantity("powers of the frequency", non_negative=True),
    )
    corner: Float[Array, ""] | None = eqx.field(
        default=None,
        converter=quantity("cycles/rad", positive=True, optional=True),
    )

    def __call__(
        self, frequency_squared: Float[Array, "*shape"], field: Float[Array, ""]
    ) -> Float[Array, "*shape"]:
        """The density up to a factor; `field` is the object's width in rad."""
        corner = 1 / field if self.corner is None else self.corner
        # Relative to the corner: powers of large numbers would overflow float32.
        return (frequency_squared / corner**2 + 1) ** (-self.exponent / 2)


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
