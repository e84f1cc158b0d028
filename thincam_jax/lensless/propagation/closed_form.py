r"""`closed_form`: the exact Fresnel field of a zone aperture without an edge."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from thincam_jax._core.precision import as_complex
from thincam_jax.lensless.masks.base import AbstractMask, pairs, require_zone_orders
from thincam_jax.lensless.propagation.chirp_sum import ChirpSum, gather_constants
from thincam_jax.lensless.propagation.path import LightPath


def closed_form(mask: AbstractMask, path: LightPath) -> ChirpSum:
    r"""PSF of the unbounded mask, exact in the Fresnel approximation (thesis Eq 3.22, corrected).

    The order k becomes :math:`c_k (1+k\epsilon)^{-1} \exp\{j k\beta/(1+k\epsilon)\, r^2/M^2\}` with
    ε = βλd/(πM); for the cosine profile the PSF is

    .. math::
        \tfrac14 + \tfrac{a_+^2 + a_-^2}{16} + \tfrac{a_+}4\cos(\beta_+ r^2+\varphi)
        + \tfrac{a_-}4\cos(\beta_- r^2+\varphi)
        + \tfrac{a_+a_-}8\cos((\beta_++\beta_-)r^2+2\varphi),

    a± = 1/(1±ε), β± = β a±. Holds in the interior of the shadow, some √(λd) from the edge of every
    order's image. Singular where an order focuses on the sensor (ε = 1 for the cosine profile): the
    unbounded mask then has no PSF. `psf` refuses that; the finite one is `separable`.
    """
    zones = require_zone_orders(mask, "closed_form")
    epsilon = path.epsilon(zones.beta)
    k = jnp.asarray(zones.orders, dtype=zones.beta.dtype)
    gain = 1 / (1 + k * epsilon)
    first, second, weights = pairs(zones.coefficients)
    # Differences of the orders' curvatures in closed form, exact as ε → 0.
    curvatures = zones.beta * (k[first] - k[second]) * gain[first] * gain[second]
    scale = path.magnification
    amplitudes = weights * as_complex(gain[first] * gain[second])
    amplitudes, curvatures = gather_constants(first == second, amplitudes, curvatures)
    return ChirpSum(amplitudes, curvatures / scale**2, scale * mask.centre)


def in_focus(mask: AbstractMask, path: LightPath) -> Bool[Array, ""]:
    """Whether an order focuses on the sensor, 1 + kε = 0: the unbounded mask has no PSF there."""
    zones = require_zone_orders(mask, "closed_form")
    k = jnp.asarray(zones.orders, dtype=zones.beta.dtype)
    return jnp.min(jnp.abs(1 + k * path.epsilon(zones.beta))) < 1e-6
