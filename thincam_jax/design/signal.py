r"""Light and variance of a design's captures: what their noise is measured against."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax.design.design import Design
from thincam_jax.design.frequencies import Frequencies, Quadrant
from thincam_jax.design.setup import Setup

# The peak of the uniform background at zero frequency: its lobes, and quadrature nodes over them.
_LOBES, _NODES = 4.0, 48


def spectral_density(setup: Setup, frequencies: Frequencies) -> Float[Array, "*point"]:
    """η_f(ν) of the scene, rad², with the variance `contrast`² over these frequencies."""
    shape = setup.prior(frequencies.squared, setup.field)
    return shape * _unit(setup, frequencies)


def _unit(setup: Setup, frequencies: Frequencies) -> Float[Array, ""]:
    shape = setup.prior(frequencies.squared, setup.field)
    return setup.contrast**2 / jnp.sum(shape * frequencies.weight)


def capture_light(design: Design, setup: Setup) -> Float[Array, " capture"]:
    """Mean of each capture of a scene of mean 1, mm²: what the object's shadow lets through."""
    shadow = design.width * (1 + design.distance / setup.object_distance)
    return _evenness(design) * jnp.minimum(shadow, setup.field * design.distance) ** 2


def signal_variance(
    design: Design,
    setup: Setup,
    frequencies: Frequencies,
    whole: Float[Array, "capture *point"],
    density: Float[Array, "*point"],
) -> Float[Array, " capture"]:
    r"""Variance of each capture over the sensor, mm⁴.

    :math:`\int \eta_f|H|^2 (1 - \mathrm{sinc}^2 L u\ \mathrm{sinc}^2 L v)`: what varies over more
    than the sensor's width L is no variance on it. `density`: η_f, by `spectral_density`.
    """
    power = whole**2 * density * frequencies.weight
    if isinstance(frequencies, Quadrant):
        window = _window(setup, frequencies.axis / design.distance[:, None])
        return jnp.sum(power * (1 - window[:, :, None] * window[:, None, :]), axis=(-2, -1))
    # The rings lie at higher frequencies; the uniform background, which they lack, varies slowly.
    even = jax.vmap(lambda d: _even_variance(design, setup, d))(design.distance)
    return jnp.sum(power, axis=(-2, -1)) + _unit(setup, frequencies) * even


def _even_variance(design: Design, setup: Setup, distance) -> Float[Array, ""]:
    """What the uniform background casts: the object through a square opening, without its mean."""
    shadow = design.width * (1 + distance / setup.object_distance)
    end = _LOBES / shadow
    nodes, weights = leggauss(_NODES)
    u = 0.5 * end * jnp.asarray(nodes + 1, end.dtype)
    both_signs = end * jnp.asarray(weights, end.dtype)
    lobe, window = jnp.sinc(shadow * u), _window(setup, u)
    power = (_evenness(design) * shadow**2 * lobe[:, None] * lobe) ** 2
    power = power * (1 - window[:, None] * window)
    prior = setup.prior((u[:, None] ** 2 + u**2) * distance**2, setup.field)
    return distance**2 * jnp.sum(power * prior * both_signs[:, None] * both_signs)


def _evenness(design: Design) -> Float[Array, ""]:
    """Σ|c_k|²: the irradiance behind the mask without its fringes."""
    mask = design.mask(design.beta[0], design.phase[0])
    return jnp.sum(jnp.abs(mask.zone_orders().coefficients) ** 2)


def _window(setup: Setup, u):
    return jnp.sinc(setup.sensor_width * u) ** 2
