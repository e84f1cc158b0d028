r"""`closed_form`: the exact Fresnel field of a zone aperture without an edge."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex

from thincam_jax._core.checks import Numbers
from thincam_jax._core.precision import as_complex, phasor
from thincam_jax.lensless.masks.base import AbstractMask, pairs, require_zone_orders
from thincam_jax.lensless.propagation.chirp_sum import ChirpSum, gather_constants
from thincam_jax.lensless.propagation.path import Path


def closed_form(mask: AbstractMask, path: Path) -> ChirpSum:
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


def harmonic_response(
    mask: AbstractMask, path: Path, harmonic: int, frequency_squared: Numbers
) -> Complex[Array, "..."]:
    r"""Response of a harmonic m > 0 of the captures over the mask's phase (`harmonic_otf`), mm².

    For ρ² in cycles²/mm² on the sensor. The pairs of orders that differ by m share a carrier, with
    X = π²ρ²/β, ε = βλd/π (and β/M² for β, ε/M for ε from a near point):

    .. math::
        H_m = \frac{j\pi}{m\beta} \sum_{k-l=m} c_k c_l^*\, e^{-j(X/m)(1+k\epsilon)(1+l\epsilon)}

    with the mask's own phase in the c_k; exact for the unbounded mask. Behind a finite one it ends
    at mβR/π, R half its width. To first order in ε the sum is that of two copies of the mask
    shifted apart; for the binary profile

    .. math::
        H_m \approx \frac{j}{m^2\beta}\, e^{-jX/m} \times \begin{cases}
            \sin(m\pi/2)\,\cos(\pi\lambda d\rho^2) & m\ \text{odd}\\
            -\cos(m\pi/2)\,\sin(\pi\lambda d\rho^2) & m\ \text{even},\
                \lambda d\rho^2 < m/2
        \end{cases}

    The odd ones are so to all orders, since 0 is the only even order of the binary profile, and
    share their zeros. The even ones, which the geometric shadow lacks, are largest there.
    """
    zones = require_zone_orders(mask, "closed_form")
    orders = zones.orders
    found = [
        (orders.index(low + harmonic), place)
        for place, low in enumerate(orders)
        if low + harmonic in orders
    ]
    if harmonic < 1:
        raise ValueError(f"harmonic = {harmonic}; give a whole number from 1 on")
    squared = jnp.asarray(frequency_squared, zones.beta.dtype)[..., None]
    first, second = np.asarray(found, int).reshape(-1, 2).T
    k = jnp.asarray(orders, dtype=zones.beta.dtype)
    gain = 1 + k * path.epsilon(zones.beta)
    beta = harmonic * zones.beta / path.magnification**2
    phases = phasor(-(jnp.pi**2) * squared / beta * gain[first] * gain[second])
    weights = zones.coefficients[first] * zones.coefficients[second].conj()
    quadrature = jax.lax.complex(jnp.zeros_like(beta), jnp.pi / beta)
    return jnp.sum(weights * phases, axis=-1) * quadrature


def in_focus(mask: AbstractMask, path: Path) -> Bool[Array, ""]:
    """Whether an order focuses on the sensor, 1 + kε = 0: the unbounded mask has no PSF there."""
    zones = require_zone_orders(mask, "closed_form")
    k = jnp.asarray(zones.orders, dtype=zones.beta.dtype)
    return jnp.min(jnp.abs(1 + k * path.epsilon(zones.beta))) < 1e-6
