"""Several masks side by side in one plane, lit together."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import quantity
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    AxisFactors,
    MaskTerms,
    Transmittance,
)


def _factored(given: Sequence[AbstractMask]) -> tuple[AbstractFactoredMask, ...]:
    masks = [mask for mask in given if isinstance(mask, AbstractFactoredMask)]
    others = {type(mask).__name__ for mask in given} - {type(mask).__name__ for mask in masks}
    if others:
        raise TypeError(
            f"masks holds a {others.pop()}, whose light is no sum of products; give masks such as "
            "FresnelZoneAperture, or put walls between them"
        )
    if not masks:
        raise ValueError("masks is empty; give two or more")
    return tuple(masks)


class SideBySide(AbstractFactoredMask):
    r"""Masks that do not overlap, :math:`t(\pmb\xi) = \sum_k t_k(\pmb\xi - \mathbf c_k)`.

    The fields behind them add up, :math:`h = |\sum_k U_k|^2`: besides the sum of their PSFs it has
    the interference of their light, whose fringes of :math:`|\mathbf c_k - \mathbf c_l|/(\lambda
    d)` cycles/mm pixels mostly average away.

    - `masks`: masks of separable terms, each with its own `centre`.
    - `centre`: (y, x) by which all are moved, mm.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.masks.side_by_side import SideBySide
    from thincam_jax.units import nm, um

    pair = [tc.FresnelZoneAperture(50.0, width=0.8, centre=(0.0, x)) for x in (-0.5, 0.5)]
    camera = tc.LenslessCamera(SideBySide(pair), tc.Sensor((24, 48), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm)
    print(h.shape)  # (24, 48)
    ```

    **See also**: `Mosaic`.
    """

    masks: tuple[AbstractFactoredMask, ...] = eqx.field(converter=_factored)
    centre: Float[Array, "2"] = eqx.field(
        default=(0.0, 0.0), converter=quantity("mm", shape=(2,)), kw_only=True
    )

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        reach = [jnp.abs(m.centre) + jnp.stack(m.extent) / 2 for m in self.masks]
        height, width = 2 * jnp.max(jnp.stack(reach), axis=0)
        return height, width

    @property
    def finest_frequency(self) -> Float[Array, ""] | None:
        finest = [mask.finest_frequency for mask in self.masks]
        known = [jnp.asarray(one) for one in finest if one is not None]
        return jnp.max(jnp.stack(known)) if known else None

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        return self._joined([mask.terms(wavelength) for mask in self.masks])

    def irradiance(self, wavelength: Number | None = None) -> MaskTerms:
        """|t|²: that of each, since they do not overlap."""
        return self._joined([mask.irradiance(wavelength) for mask in self.masks])

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Transmittance:
        moved = (mask.centre + self.centre for mask in self.masks)
        masks = [
            eqx.tree_at(lambda m: m.centre, mask, centre)
            for mask, centre in zip(self.masks, moved, strict=True)
        ]
        return jnp.sum(jnp.stack([mask.sample(grid, wavelength) for mask in masks]), axis=0)

    def _joined(self, parts: list[MaskTerms]) -> MaskTerms:
        """The terms of all, each zero outside of its own mask."""
        rows, columns = (
            _side_by_side([side(part) for part in parts], [m.centre[axis] for m in self.masks])
            for axis, side in enumerate(_SIDES)
        )
        return MaskTerms(jnp.concatenate([p.coefficients for p in parts]), rows, columns)


_SIDES: tuple[Callable[[MaskTerms], AxisFactors], ...] = (lambda t: t.rows, lambda t: t.columns)


def _side_by_side(factors: list[AxisFactors], centres: list[Float[Array, ""]]) -> AxisFactors:
    """One array of cells, with a dark one between the masks."""
    edges = [f.edges + centre for f, centre in zip(factors, centres, strict=True)]
    values, origins = [], []
    for number, (one, centre) in enumerate(zip(factors, centres, strict=True)):
        dark = jnp.zeros((len(one.values), int(number < len(factors) - 1)), one.values.dtype)
        values.append(jnp.concatenate([one.values, dark], axis=1))
        own = jnp.zeros(one.values.shape[1], edges[0].dtype) if one.origins is None else one.origins
        origins.append(jnp.pad(own, (0, dark.shape[1])) + centre)
    curvatures = None
    if any(one.curvatures is not None for one in factors):
        curvatures = jnp.concatenate(
            [
                jnp.zeros(len(one.values), edges[0].dtype) if g is None else g
                for one, g in ((one, one.curvatures) for one in factors)
            ]
        )
    return AxisFactors(
        jnp.concatenate(edges),
        jax.scipy.linalg.block_diag(*values),
        curvatures,
        None if curvatures is None else jnp.concatenate(origins),
    )
