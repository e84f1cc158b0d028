r"""`geometric`: the mask's shadow, without diffraction."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, phasor, product
from thincam_jax.lensless.masks.base import AbstractMask, ZoneOrders, axis_orders, pairs
from thincam_jax.lensless.propagation.chirp import chirp_average
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.propagation.separable_sum import SeparableSum


def geometric(
    mask: AbstractMask, grid: Grid, path: Path, *, pixel_integration: bool = False
) -> SeparableSum | Float[Array, "y x"]:
    r"""Shadow of the mask, magnified by M (thesis Eq 3.3, corrected): h(r) = |t(r/M)|².

    The limit of all wave models as λ → 0. For the cosine profile this is
    3/8 + ½cos(βr²/M²+φ) + ⅛cos(2βr²/M²+2φ): the thesis' Eq 3.5 takes t itself as the irradiance,
    which differs in the constant and the second harmonic, and agrees after fringe scanning.

    Point-sampled, the shadow's edge is a step, so that the derivative with respect to the width is
    zero; pixel averages are exact (Fresnel integrals) and differentiable in the width too.
    A mask without zone orders is sampled on the shadow's grid, averaging over its cells.
    """
    scale = path.magnification
    if not hasattr(mask, "zone_orders"):
        shadow = mask.sample(Grid(grid.shape, grid.pitch / scale))
        return jnp.abs(shadow) ** 2
    down, across = axis_orders(mask, "geometric")
    factor = _axis_averages if pixel_integration else _axis_values
    orders, weights = _irradiance_orders(across)
    y, x = grid.y / scale - mask.centre[0], grid.x / scale - mask.centre[1]
    if down is across:
        # Both axes at once: half as much to compile.
        both = factor(across, orders, jnp.concatenate([y, x]), grid.pitch / scale)
        rows, columns = jnp.split(both, [grid.shape[0]], axis=-1)
    else:
        rows = factor(down, orders, y, grid.pitch / scale)
        columns = factor(across, orders, x, grid.pitch / scale)
    return SeparableSum(weights[:, None] * rows, columns, grid)


def _irradiance_orders(zones: ZoneOrders) -> tuple[np.ndarray, Complex[Array, " term"]]:
    """Orders m ≥ 0 and weights of |t|² = Σ_m Re{w_m e^{jmβr²}}."""
    first, second, weights = pairs(zones)
    k = np.asarray(zones.orders)
    difference = k[first] - k[second]
    # A pair and its conjugate carry the same real part: fold the negative orders onto the positive.
    folded = jnp.where(difference < 0, weights.conj(), weights)
    orders, position = np.unique(np.abs(difference), return_inverse=True)
    return orders, jnp.zeros(len(orders), weights.dtype).at[position].add(folded)


def _axis_values(zones: ZoneOrders, orders, x: Float[Array, " n"], pitch):
    m = jnp.asarray(orders, dtype=x.dtype)[:, None]
    inside = (x[:, None] >= zones.lower) & (x[:, None] <= zones.upper)
    if zones.sites is None:
        return jnp.where(inside[:, 0], phasor(m * zones.beta * x**2), 0.0)
    values = phasor(m * zones.beta * zones.sites**2)
    return product(values, as_complex(inside.T.astype(x.dtype)))


def _axis_averages(zones: ZoneOrders, orders, x: Float[Array, " n"], pitch):
    m = jnp.asarray(orders, dtype=x.dtype)[:, None]
    # Ends relative to the pixel's centre: exact where the pixel is whole.
    lower = jnp.maximum(-pitch / 2, zones.lower - x[:, None])
    upper = jnp.maximum(jnp.minimum(pitch / 2, zones.upper - x[:, None]), lower)
    if zones.sites is None:
        middle, half = x + (lower + upper)[:, 0] / 2, (upper - lower)[:, 0] / 2
        return chirp_average(m * zones.beta, middle, half) * as_complex(1 / pitch)
    values = phasor(m * zones.beta * zones.sites**2)
    return product(values, as_complex(((upper - lower) / pitch).T))
