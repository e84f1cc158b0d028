r"""`paraxial`: the thesis' approximation for weak diffraction, ε = λβd/π → 0."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.checks import Number, Numbers
from thincam_jax.lensless.masks.base import AbstractMask, pairs, require_zone_orders
from thincam_jax.lensless.propagation.chirp_sum import ChirpSum, gather_constants
from thincam_jax.lensless.propagation.path import LightPath


def paraxial(mask: AbstractMask, path: LightPath) -> ChirpSum:
    r"""PSF of the unbounded mask to first order in ε in the phase (thesis Eq 3.26, corrected).

    .. math::
        h = \tfrac14 + \tfrac12\cos(\epsilon\beta r^2)\cos(\beta r^2+\varphi)
            + \tfrac14\cos^2(\beta r^2+\varphi)

    on the shadow's scale r/M, with the transform (Eq 3.30, corrected)

    .. math::
        H \approx \tfrac38\delta + \tfrac{\pi}{2\beta}\cos(\pi\lambda d\rho^2)
            \sin(\tfrac{\pi^2\rho^2}{\beta} - \varphi)
            + \tfrac{\pi}{16\beta}\sin(\tfrac{\pi^2\rho^2}{2\beta} - 2\varphi).

    Of the closed form, the gains 1/(1+kε) are set to 1 and kβ/(1+kε) to kβ(1 − kε). The phase so
    left out is ε²βr²: the model is for ε²β(width/2)² ≪ 1. The same expansion serves every pair of
    orders of the binary profile.
    """
    zones = require_zone_orders(mask, "paraxial")
    epsilon = path.epsilon(zones.beta)
    k = jnp.asarray(zones.orders, dtype=zones.beta.dtype)
    first, second, weights = pairs(zones.coefficients)
    difference, total = k[first] - k[second], k[first] + k[second]
    curvatures = zones.beta * difference * (1 - total * epsilon)
    weights, curvatures = gather_constants(first == second, weights, curvatures)
    scale = path.magnification
    return ChirpSum(weights, curvatures / scale**2, scale * mask.centre)


def paraxial_response(
    frequency_squared: Numbers, beta: Number, phase: Number, wavelength: Number, distance: Number
) -> Float[Array, "..."]:
    r"""The OTF of Eq 3.30 (corrected) without its δ, for ρ² in cycles²/mm² and t → ∞, mm².

    .. math::
        \tfrac{\pi}{2\beta}\cos(\pi\lambda d\rho^2)\sin(\tfrac{\pi^2\rho^2}{\beta} - \varphi)
        + \tfrac{\pi}{16\beta}\sin(\tfrac{\pi^2\rho^2}{2\beta} - 2\varphi)
    """
    x = jnp.pi**2 * frequency_squared / beta
    diffraction = jnp.cos(jnp.pi * wavelength * distance * frequency_squared)
    first = jnp.pi / (2 * beta) * diffraction * jnp.sin(x - phase)
    return jnp.asarray(first + jnp.pi / (16 * beta) * jnp.sin(x / 2 - 2 * phase))
