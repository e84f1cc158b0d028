r"""`geometric`: the mask's shadow, without diffraction."""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, product
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    AxisFactors,
    other_models,
)
from thincam_jax.lensless.propagation.chirp import chirp_average
from thincam_jax.lensless.propagation.separable import SeparableSum


def geometric(
    mask: AbstractMask, grid: Grid, path: LightPath, *, pixel_integration: bool = True
) -> SeparableSum | Float[Array, "y x"]:
    r"""Shadow of the mask, magnified by M (thesis Eq 3.3, corrected): h(r) = |t(r/M)|².

    The limit of all wave models as λ → 0. For the cosine profile this is
    3/8 + ½cos(βr²/M²+φ) + ⅛cos(2βr²/M²+2φ): the thesis' Eq 3.5 takes t itself as the irradiance,
    which differs in the constant and the second harmonic, and agrees after fringe scanning.

    Point-sampled, the shadow's edge is a step, so that the derivative with respect to the width is
    zero; pixel averages are exact (Fresnel integrals) and differentiable in the width too.
    A mask without separable terms is sampled on the shadow's grid, averaging over its cells.

    **Errors**: TypeError for a pure phase mask, whose shadow is its open aperture.
    """
    scale = path.magnification
    if mask.pure_phase:
        raise TypeError(
            f"model 'geometric' is the shadow |t|², which a {type(mask).__name__} does not have; "
            f"use {other_models(mask)}"
        )
    if not isinstance(mask, AbstractFactoredMask):
        shadow = mask.sample(Grid(grid.shape, grid.pitch / scale), path.wavelength)
        return jnp.abs(shadow) ** 2
    terms = mask.irradiance(path.wavelength)
    down, across = terms.rows, terms.columns
    factor = _axis_averages if pixel_integration else _axis_values
    y, x = path.on_mask(grid, mask.centre)
    if down is across:
        # Both axes at once: half as much to compile.
        both = factor(across, jnp.concatenate([y, x]), grid.pitch / scale)
        rows, columns = jnp.split(both, [grid.shape[0]], axis=-1)
    else:
        rows, columns = factor(down, y, grid.pitch / scale), factor(across, x, grid.pitch / scale)
    return SeparableSum(terms.coefficients[:, None] * rows, columns, grid)


def _axis_values(factors: AxisFactors, x: Float[Array, " n"], pitch) -> Complex[Array, "term n"]:
    offset = factors.edges - x[:, None]
    # A point on an edge belongs to the cell behind it; on the last one, to the last cell.
    before_end = (offset[:, 1:] > 0).at[:, -1].set(offset[:, -1] >= 0)
    inside = (offset[:, :-1] <= 0) & before_end
    if factors.curvatures is None:
        return product(factors.values, as_complex(inside.T.astype(x.dtype)))
    shown = factors.values[:, None] * factors.chirps(x)
    return jnp.sum(jnp.where(inside, shown, 0.0), axis=-1)


def _axis_averages(factors: AxisFactors, x: Float[Array, " n"], pitch) -> Complex[Array, "term n"]:
    # Ends relative to the pixel's centre: exact where the pixel is whole.
    offset = factors.edges - x[:, None]
    lower = jnp.maximum(-pitch / 2, offset[:, :-1])
    upper = jnp.maximum(jnp.minimum(pitch / 2, offset[:, 1:]), lower)
    if factors.curvatures is None:
        return product(factors.values, as_complex(((upper - lower) / pitch).T))
    middle, half = factors.from_origins(x) + (lower + upper) / 2, (upper - lower) / 2
    averages = chirp_average(factors.curvatures[:, None, None], middle, half)
    return jnp.sum(factors.values[:, None] * averages, axis=-1) * as_complex(1 / pitch)
