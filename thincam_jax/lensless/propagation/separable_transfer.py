r"""The transfer function of a square aperture in closed form, at any frequency, without sampling.

The irradiance behind a mask of separable zone orders is a short sum of products of one-dimensional
factors A_k(x) A_l*(x) (`separable`). The transform of such a factor is, by the convolution theorem
for Fresnel propagation, an overlap of the aperture with itself, displaced by s = λdu:

.. math::
    T_{kl}(u) = \int (A_k A_l^*)(x)\, e^{-2\pi jux} dx
              = M \int_{|\zeta| \le w/2 - |s|/2} e^{jk\beta(\zeta - s/2)^2
                - jl\beta(\zeta + s/2)^2 - 2\pi jMu\zeta}\, d\zeta

which is a finite chirp for k ≠ l and a sinc for k = l. So the transfer function needs no PSF: one
pair of Fresnel integrals a frequency and pair of orders in place of a field on every pixel.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.precision import as_complex, phasor, product
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractMask, ZoneOrders, pairs, require_zone_orders
from thincam_jax.lensless.propagation.chirp import chirp_integral


class TransferFactors(eqx.Module):
    r"""A real transfer function :math:`H(u, v) = \sum_m \mathrm{Re}\{Y_m(v) X_m(u)\}`, mm².

    - `rows`: Y_m at the frequencies v, with all constant factors.
    - `columns`: X_m at the frequencies u.
    """

    rows: Complex[Array, "term v"]
    columns: Complex[Array, "term u"]

    def response(self) -> Float[Array, "v u"]:
        """H at every pair of the frequencies."""
        rows = jnp.concatenate([self.rows.real, -self.rows.imag])
        return product(rows.T, jnp.concatenate([self.columns.real, self.columns.imag]))


def transfer_factors(
    mask: AbstractMask,
    path: LightPath,
    v: Float[Array, " v"],
    u: Float[Array, " u"],
    *,
    pixel_pitch: Number | None = None,
) -> TransferFactors:
    r"""Transfer function of a centred mask at the frequencies (v, u) on the sensor, cycles/mm.

    Exact within the Fresnel approximation, as `separable`, whose sampled PSF it transforms without
    the alias that sampling folds in. `pixel_pitch`: mm; averages over square pixels, a factor
    sinc(pv) sinc(pu).

    **Errors**: ValueError for a mask of display pixels, TypeError for one that is no zone plate.
    """
    zones = require_zone_orders(mask, "transfer_factors")
    weights = pairs(zones.coefficients)[2]

    def factors(side, frequency):
        values = overlaps(replace(zones, width=side), path, frequency)
        if pixel_pitch is not None:
            values = values * as_complex(jnp.sinc(pixel_pitch * frequency))
        return values

    height, width = mask.extent
    if height is width:
        both = factors(width, jnp.concatenate([v, u]))
        rows, columns = jnp.split(both, [v.shape[0]], axis=-1)
    else:
        rows, columns = factors(height, v), factors(width, u)
    return TransferFactors(weights[:, None] * rows, columns)


def overlaps(zones: ZoneOrders, path: LightPath, u: Float[Array, " u"]) -> Complex[Array, "pair u"]:
    """T_kl(u) of the pairs k ≤ l of orders, mm; 0 beyond the aperture's cut-off w/(λd)."""
    shift = path.wavelength * path.distance * u
    values = overlaps_of(zones.orders, zones.beta, zones.width, shift, path.magnification * u)
    return values * as_complex(path.magnification)


def overlaps_of(
    orders: tuple[int, ...],
    beta: Float[Array, "*#batch"],
    width: Float[Array, ""],
    shift: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
) -> Complex[Array, "pair *batch"]:
    """T_kl/M for arrays of s = λdu (mm), Mu (cycles/mm) and β: elementwise in all of them."""
    half = 0.5 * (width - jnp.abs(shift))
    reached = half > 0
    half = jnp.where(reached, half, 0.0)
    beta = jnp.broadcast_to(beta, shift.shape)
    first, second = np.triu_indices(len(orders))
    k, m = (np.asarray(orders)[i] for i in (first, second))

    def along_pairs(values, which):
        of_pair = jnp.asarray(values[which], shift.dtype)
        return of_pair.reshape(-1, *(1 for _ in shift.shape))

    def tilt(which):
        return along_pairs(k + m, which) * beta * shift + 2 * jnp.pi * frequency

    same, other = first == second, first != second
    values = as_complex(2 * half * jnp.sinc(tilt(same) * half / jnp.pi))
    if np.any(other):
        curvature = along_pairs(k - m, other) * beta
        # Around the chirp's stationary point: its phase there is that of the infinite aperture.
        centre = tilt(other) / (2 * curvature)
        phase = curvature * (shift**2 / 4 - centre**2)
        chirps = _chirp(*jnp.broadcast_arrays(curvature, centre, half)) * phasor(phase)
        values = jnp.concatenate([values, chirps])
        values = values[np.argsort(np.concatenate([np.flatnonzero(same), np.flatnonzero(other)]))]
    return jnp.where(reached, values, 0.0)


@jax.custom_jvp
def _chirp(b, x, half) -> Complex[Array, "..."]:
    """∫ e^{jb(ζ−x)²} dζ over ±half, b ≠ 0."""
    return chirp_integral(jnp.zeros_like(x), b, x, -half, half)


@_chirp.defjvp
def _chirp_slope(primals, tangents):
    """Slope by the values at the ends, ∂/∂b by parts; half the time of Fresnel integrals'."""
    b, x, half = primals
    b_dot, x_dot, half_dot = tangents
    value = _chirp(b, x, half)
    upper, lower = half - x, -half - x
    at_upper, at_lower = phasor(b * upper**2), phasor(b * lower**2)
    by_b = as_complex(upper) * at_upper - as_complex(lower) * at_lower - value
    slope = as_complex(b_dot / (2 * b)) * by_b + as_complex(half_dot) * (at_upper + at_lower)
    return value, slope - as_complex(x_dot) * (at_upper - at_lower)
