r"""What makes a design good: pure functions of it, differentiable in every number.

All but the end-to-end ones rest on what the captures say of each frequency of the scene. With
responses H_k, noise spectra η_k and the synthesis W (`reconstruction.synthesis`) this is

.. math:: J(\nu) = \sum_c \frac{|\sum_k W_{ck} \bar H_k|^2}
    {\sum_k W_{ck}^2 \eta_k + \eta_c^{crop}}

where H̄ is what the sensor sees of H, and η^crop what it cuts off (`thincam_jax.design.response`).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax.design.design import Design
from thincam_jax.design.frequencies import Frequencies
from thincam_jax.design.response import responses
from thincam_jax.design.setup import Setup
from thincam_jax.design.signal import capture_light, signal_variance, spectral_density


class Channels(eqx.Module):
    """The sums of captures that a reconstruction starts from, at each frequency.

    - `response`: of each, H̄, as seen at one distance: mm²·mm.
    - `noise`: its noise spectrum η, with what the sensor cuts off.
    - `density`: η_f of the scene.
    - `weight`: of the integral over frequencies.
    """

    response: Float[Array, "channel *point"]
    noise: Float[Array, "channel *point"]
    density: Float[Array, "*point"]
    weight: Float[Array, "*point"]

    @property
    def information(self) -> Float[Array, "*point"]:
        """J."""
        return jnp.sum(self.response**2 / self.noise, axis=0)

    @property
    def signal_to_noise(self) -> Float[Array, "*point"]:
        """η_f J: what is known of a frequency over what is not."""
        return self.density * self.information


def channels(
    design: Design,
    setup: Setup,
    synthesis: Float[Array, "channel capture"],
    frequencies: Frequencies,
) -> Channels:
    """From a design to what its captures tell; `synthesis`: a matrix with orthogonal rows."""
    matrix = jnp.asarray(synthesis, design.beta.dtype)
    if matrix.ndim != 2 or matrix.shape[1] != design.captures:
        raise ValueError(
            f"synthesis has shape {matrix.shape}; give (channel, {design.captures}), one column "
            "for each capture"
        )
    found = responses(design, setup, frequencies)
    # Kept apart: fused into all that uses it, the power law would be computed for each.
    density = jax.lax.optimization_barrier(spectral_density(setup, frequencies))
    signal = signal_variance(design, setup, frequencies, found.whole, density)
    light = capture_light(design, setup)
    noise = setup.noise.variance(light, signal, design.exposure) * setup.pitch**2
    # Per area of the sensor the scene's density grows with the distance squared, noise does not.
    whole, seen = (_sums(matrix * design.distance, h) for h in (found.whole, found.seen))
    cut_off = jnp.maximum(whole * seen - seen**2, 0.0) * density
    return Channels(seen, (matrix**2 @ noise)[:, None, None] + cut_off, density, frequencies.weight)


def _sums(
    matrix: Float[Array, "channel capture"], responses: Float[Array, "capture *point"]
) -> Float[Array, "channel *point"]:
    """Written out: compiled as a matrix product, it would be computed for each of its uses."""
    return jnp.stack([sum(w * h for w, h in zip(row, responses, strict=True)) for row in matrix])  # pyright: ignore


def bayes_error(known: Channels) -> Float[Array, ""]:
    r"""Error of the best linear reconstruction, as a part of the scene's variance.

    .. math:: \int \frac{d^2\nu}{1/\eta_f + J(\nu)} \Big/ \int \eta_f\, d^2\nu

    (thesis Eq 3.48, corrected: ERRATA 3.46). 0 is a perfect image, 1 knows nothing.
    """
    error = known.density / (1 + known.signal_to_noise)
    return jnp.sum(error * known.weight) / jnp.sum(known.density * known.weight)


def mismatch_error(known: Channels, actual: Channels) -> Float[Array, ""]:
    r"""Error of the same, if the camera is not what the reconstruction takes it for.

    .. math:: \int \eta_f\Big(1 - \sum_c P_c H'_c\Big)^2 + \sum_c P_c^2\,\eta'_c,
        \qquad P_c = \frac{H_c/\eta_c}{1/\eta_f + J}

    with H′, η′ of the camera as it is. For H′ = H it is `bayes_error`.
    """
    filters = known.response / known.noise * known.density / (1 + known.signal_to_noise)
    transfer = jnp.sum(filters * actual.response, axis=0)
    error = known.density * (1 - transfer) ** 2 + jnp.sum(filters**2 * actual.noise, axis=0)
    return jnp.sum(error * known.weight) / jnp.sum(known.density * known.weight)


def ring_means(known: Channels, frequencies: Frequencies, rings: int) -> Float[Array, " ring"]:
    """The signal-to-noise ratio, averaged over rings of equal width.

    Its fringes are finer than what a picture shows; a ring's mean is what an edge of that
    fineness meets.
    """
    return over_rings(known.signal_to_noise, frequencies, rings)


def over_rings(
    values: Float[Array, "*point"], frequencies: Frequencies, rings: int
) -> Float[Array, " ring"]:
    """Means over rings of equal width, by area."""
    ring = frequencies.ring(rings)
    weight = frequencies.weight
    total = jax.ops.segment_sum((values * weight).ravel(), ring, rings + 1)[:-1]
    return total / jax.ops.segment_sum(weight.ravel(), ring, rings + 1)[:-1]


def worst_ratio_db(
    known: Channels, frequencies: Frequencies, band: tuple[float, float], *, rings: int = 64
) -> Float[Array, ""]:
    """The lowest signal-to-noise ratio of a ring in a band, dB, as a soft minimum (1 dB).

    `band`: lowest and highest frequency as parts of the highest looked at.
    """
    level = 10 * jnp.log10(ring_means(known, frequencies, rings) + _tiny(known))
    inside = _in_band(band, rings, level.dtype)
    return -jax.nn.logsumexp(jnp.where(inside, -level, -jnp.inf))


def unevenness(
    known: Channels, frequencies: Frequencies, band: tuple[float, float], *, rings: int = 64
) -> Float[Array, ""]:
    """Standard deviation of the information over the rings of a band, in dB: 0 is flat.

    The thesis asks for a flat amplitude (after Eq 3.48): no frequency is amplified into noise.
    """
    flat = replace(known, density=jnp.ones_like(known.density))
    level = 10 * jnp.log10(ring_means(flat, frequencies, rings) + _tiny(known))
    inside = _in_band(band, rings, level.dtype)
    count = jnp.sum(inside).astype(level.dtype)
    mean = jnp.sum(jnp.where(inside, level, 0.0)) / count
    spread = jnp.sum(jnp.where(inside, (level - mean) ** 2, 0.0)) / count
    return jnp.sqrt(spread + jnp.finfo(level.dtype).eps)


def limit(
    known: Channels, frequencies: Frequencies, *, ratio: float = 1.0, rings: int = 64
) -> Float[Array, ""]:
    """The frequency up to which every ring is above a signal-to-noise ratio, cycles/rad.

    The first zero, if it is wider than a ring; else the cut-off of aperture, pixel and noise.
    Interpolated between rings on a logarithmic scale; the highest frequency if none falls below.
    """
    level = jnp.log(ring_means(known, frequencies, rings) + _tiny(known)) - jnp.log(ratio)
    below = level < 0
    first = jnp.where(jnp.any(below), jnp.argmax(below), rings)
    before, after = level[jnp.maximum(first - 1, 0)], level[jnp.minimum(first, rings - 1)]
    fall = jnp.where(below[jnp.minimum(first, rings - 1)], before - after, 1.0)
    place = first.astype(level.dtype) - 0.5 + before / jnp.where(fall > 0, fall, 1.0)
    place = jnp.where(first == 0, 0.0, jnp.where(first == rings, float(rings), place))
    return frequencies.highest * place / rings


def _in_band(band: tuple[float, float], rings: int, dtype) -> Bool[Array, " ring"]:
    places = jnp.asarray((np.arange(rings) + 0.5) / rings, dtype)
    return (places >= band[0]) & (places <= band[1])


def _tiny(known: Channels):
    return jnp.finfo(known.density.dtype).tiny
