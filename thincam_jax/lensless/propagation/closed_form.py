"""Fields of zone apertures without an edge: `closed_form`, and `paraxial` for weak diffraction."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, phasor, turn_phasor
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractMask, pairs, require_zone_orders
from thincam_jax.lensless.propagation.chirp import chirp_average
from thincam_jax.lensless.propagation.separable import SeparableSum


class ChirpSum(eqx.Module):
    r"""The image :math:`\sum_m \mathrm{Re}\{ w_m e^{j\gamma_m |\mathbf r - \mathbf r_0|^2} \}`.

    - `weights`: w_m.
    - `curvatures`: γ_m on the sensor, rad/mm²; 0 is a constant.
    - `centre`: (y, x) of r₀ on the sensor, mm.
    """

    weights: Complex[Array, " term"]
    curvatures: Float[Array, " term"]
    centre: Float[Array, "2"]

    def sample(self, grid: Grid, *, pixel_integration: bool) -> SeparableSum:
        """Samples at a grid's pixel centres, or averaged over its pixels (Fresnel integrals)."""
        # Both axes at once: half as much to compile.
        points = jnp.concatenate([grid.y - self.centre[0], grid.x - self.centre[1]])
        curvatures = self.curvatures[:, None]
        if pixel_integration:
            both = chirp_average(curvatures, points, grid.pitch / 2) * as_complex(1 / grid.pitch)
        else:
            both = phasor(curvatures * points**2)
        rows, columns = jnp.split(both, [grid.shape[0]], axis=-1)
        return SeparableSum(self.weights[:, None] * rows, columns, grid)

    def transform(self, grid: Grid) -> Complex[Array, "v u"]:
        r"""Fourier transform on the grid's centred frequencies, mm².

        :math:`\mathcal F\,\mathrm{Re}\{w e^{j\gamma r^2}\} = \mathrm{Re}\{ w\,(j\pi/\gamma)
        e^{-j\pi^2\rho^2/\gamma}\}` (thesis Eq 3.11, 3.12 with the corrected constants). A constant
        w is w·δ(u,v); on the grid δ is one over the area of a frequency cell.
        """
        constant = self.curvatures == 0
        gamma = jnp.where(constant, 1.0, self.curvatures)[:, None]
        quadrature = jax.lax.complex(jnp.zeros_like(self.curvatures), jnp.pi / gamma[:, 0])
        weights = jnp.where(constant, 0.0, self.weights * quadrature)
        rows = phasor(-(jnp.pi**2) * grid.v**2 / gamma)
        columns = phasor(-(jnp.pi**2) * grid.u**2 / gamma)
        chirps = SeparableSum(weights[:, None] * rows, columns, grid).image()
        area = grid.shape[0] * grid.shape[1] * grid.pitch**2
        delta = jnp.sum(jnp.where(constant, self.weights.real, 0.0)) * area
        spectrum = chirps.at[grid.shape[0] // 2, grid.shape[1] // 2].add(delta)
        shift = turn_phasor(-grid.v * self.centre[0])[:, None] * turn_phasor(
            -grid.u * self.centre[1]
        )
        return as_complex(spectrum) * shift


def gather_constants(
    constant: Bool[np.ndarray, " pair"],
    weights: Complex[Array, " pair"],
    curvatures: Float[Array, " pair"],
) -> tuple[Complex[Array, " term"], Float[Array, " term"]]:
    """One term for all pairs of an order with itself, which have no fringes."""
    total = jnp.sum(weights[constant], keepdims=True)
    none = jnp.zeros(1, curvatures.dtype)
    return (
        jnp.concatenate([total, weights[~constant]]),
        jnp.concatenate([none, curvatures[~constant]]),
    )


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
