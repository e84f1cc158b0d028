"""Interface of masks to the propagation models."""

import abc
import functools
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, cell_overlap, centred_indices
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, phasor, product
from thincam_jax._core.quantity import unchecked

Transmittance = Complex[Array, "y x"] | Float[Array, "y x"]


class AbstractMask(Module):
    """A thin mask in the plane z = 0, given by its amplitude transmittance.

    - `centre`: (y, x) of the mask's centre relative to the optical axis, mm.

    Every mask can be sampled on a grid; that is all that `angular_spectrum` and
    `rayleigh_sommerfeld` ask for. Those that are a sum of products of one factor along y and one
    along x are an `AbstractFactoredMask`, and have an exact PSF by `separable`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.SampledMask([[1.0, 0.0], [0.0, 1.0]], pitch=50 * um)
    print(mask.sample(tc.Grid((2, 3), 50 * um)).shape)  # (2, 3)
    ```

    **See also**: `AbstractFactoredMask`, `PhaseMask`.
    """

    centre: eqx.AbstractVar[Float[Array, "2"]]
    # The model that has the mask's Fresnel field exactly; None of masks that are only sampled.
    exact_model: ClassVar[Literal["separable", "radial"] | None] = None

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Height and width of the open aperture, mm."""

    @abc.abstractmethod
    def sample(self, grid: Grid, wavelength: Number | None = None) -> Transmittance:
        """Amplitude transmittance on a grid; cells cut by the aperture count by their open area.

        `wavelength`: mm, of the light; a mask whose transmittance is the same for all takes none.
        """

    def without_dark_margins(self) -> "AbstractMask":
        """Mask of the same transmittance and fewer cells, where those at its edges are dark."""
        return self

    @property
    def finest_frequency(self) -> Float[Array, ""] | float | None:
        """Highest spatial frequency of the mask, cycles/mm; None where it is not known."""
        return None

    @property
    def pure_phase(self) -> bool:
        """Whether |t| = 1 all over the aperture: its shadow, the model "geometric", has no code."""
        return False


class AxisFactors(Module):
    r"""The factors of a mask's terms along one axis, over an array of cells.

    In cell i, between the edges i and i + 1, the factor of term k is

    .. math:: v_{ki}\, e^{jg_k(\xi - o_i)^2}

    and zero before the first edge and behind the last. A gap between open cells is a cell of zeros.

    - `edges`: ascending, mm, relative to the mask's centre.
    - `values`: v_ki.
    - `curvatures`: g_k, rad/mm²; None where every cell is constant.
    - `origins`: o_i, mm; None for zero.

    ```python
    import jax.numpy as jnp
    from thincam_jax.lensless.masks import AxisFactors, MaskTerms

    slit = AxisFactors(jnp.array([-0.1, 0.1]), jnp.array([[1.0 + 0.0j]]))  # one open cell
    terms = MaskTerms(jnp.array([1.0 + 0.0j]), slit, slit)
    ```

    **See also**: `lensless.masks.MaskTerms`.
    """

    edges: Float[Array, " edge"]
    values: Complex[Array, "term cell"]
    curvatures: Float[Array, " term"] | None = None
    origins: Float[Array, " cell"] | None = None

    def chirps(self, x: Float[Array, " n"]) -> Complex[Array, "term n cell"]:
        """e^{jg(x − o)²} of every term and cell, at coordinates relative to the mask's centre."""
        assert self.curvatures is not None
        return phasor(self.curvatures[:, None, None] * self.from_origins(x) ** 2)

    def from_origins(self, x: Float[Array, " n"]) -> Float[Array, "n #cell"]:
        """x − o_i."""
        return x[:, None] if self.origins is None else x[:, None] - self.origins

    def samples(self, x: Float[Array, " n"], pitch: Float[Array, ""]) -> Complex[Array, "term n"]:
        """The factors at samples `pitch` apart, each weighted by the open part of its length."""
        covered = cell_overlap(x, pitch, self.edges[:-1], self.edges[1:]) / pitch
        if self.curvatures is None:
            return product(self.values, as_complex(covered.T))
        return jnp.sum(self.values[:, None] * self.chirps(x) * as_complex(covered), axis=-1)

    def products(self, first: np.ndarray, second: np.ndarray) -> "AxisFactors":
        """The factors of the products of terms `first` with the conjugates of terms `second`."""
        g = self.curvatures
        return replace(
            self,
            values=self.values[first] * self.values[second].conj(),
            curvatures=None if g is None else g[first] - g[second],
        )


def open_parts(
    values: Complex[Array, "term cell"],
    pitch: Float[Array, ""],
    fill_factor: Float[Array, ""],
    gaps: Complex[Array, "term 1"] | None = None,
) -> AxisFactors:
    """Cells `pitch` apart about the mask's centre, open in their middle √fill_factor.

    `gaps`: each factor's value between the cells; None for dark ones.
    """
    centres = centred_indices(values.shape[1], pitch.dtype) * pitch
    half = pitch * jnp.sqrt(fill_factor) / 2
    edges = jnp.stack([centres - half, centres + half], axis=-1).ravel()
    between = jnp.zeros_like(values) if gaps is None else jnp.broadcast_to(gaps, values.shape)
    with_gaps = jnp.stack([values, between], axis=-1)
    return AxisFactors(edges, with_gaps.reshape(len(values), -1)[:, :-1])


class MaskTerms(Module):
    r"""A mask as a sum of products, :math:`t(x, y) = \sum_k c_k R_k(y)\, C_k(x)`.

    - `coefficients`: the c_k.
    - `rows`, `columns`: the R_k and the C_k; one object where both axes have the same.

    ```python
    import thincam_jax as tc

    terms = tc.Pinhole(0.5).terms()
    print(len(terms.coefficients))  # 1
    ```

    **See also**: `lensless.masks.AxisFactors`, `AbstractFactoredMask`.
    """

    coefficients: Complex[Array, " term"]
    rows: AxisFactors
    columns: AxisFactors


class AbstractFactoredMask(AbstractMask):
    """A mask that is a sum of products of one-dimensional factors: all classical coded apertures.

    The field behind it is such a sum too, diffraction included, in closed form.

    ```python
    import thincam_jax as tc

    mask = tc.Pinhole(0.5, height=0.2)
    print(mask.terms().coefficients.shape)  # (1,)
    ```

    **See also**: `lensless.masks.MaskTerms`, `lensless.masks.base.AbstractMask`.
    """

    exact_model = "separable"

    @abc.abstractmethod
    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        """t(x, y), for light of a wavelength in mm where that matters."""

    def irradiance(self, wavelength: Number | None = None) -> MaskTerms:
        """|t|² = Re Σ_k w_k R_k(y) C_k(x)."""
        terms = self.terms(wavelength)
        first, second, weights = pairs(terms.coefficients)
        across = terms.columns.products(first, second)
        same = terms.rows is terms.columns
        down = across if same else terms.rows.products(first, second)
        return MaskTerms(weights, down, across)

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Transmittance:
        terms = self.terms(wavelength)
        rows = terms.rows.samples(grid.y - self.centre[0], grid.pitch)
        columns = terms.columns.samples(grid.x - self.centre[1], grid.pitch)
        return product((terms.coefficients[:, None] * rows).T, columns)


@dataclass(frozen=True)
class TermCount:
    """Number of terms of a mask and of its |t|², and the cells of its longer side."""

    terms: int
    shadow: int
    cells: int
    chirped: bool


def term_count(mask: AbstractFactoredMask) -> TermCount:
    """Known without the mask's numbers, also while they are traced."""
    leaves, structure = jax.tree.flatten(mask)
    return _count(structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves))


@functools.lru_cache(maxsize=256)
def _count(structure: Any, leaves: tuple) -> TermCount:
    mask = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    colour = jax.ShapeDtypeStruct((), mask.centre.dtype)
    terms = jax.eval_shape(lambda mask, w: mask.terms(w), mask, colour)
    shadow = jax.eval_shape(lambda mask, w: mask.irradiance(w), mask, colour)
    cells = max(axis.values.shape[1] for axis in (terms.rows, terms.columns))
    counts = terms.coefficients.shape[0], shadow.coefficients.shape[0]
    return TermCount(*counts, cells, terms.columns.curvatures is not None)


# Terms of a mask up to which `separable` squares them one by one, in one dimension; of more, it
# adds up the field first.
_MOST_TERMS = 128


def has_few_terms(mask: AbstractMask) -> TypeGuard[AbstractFactoredMask]:
    """Whether the mask is a sum of so few products that its PSF is a short sum of them, too."""
    return isinstance(mask, AbstractFactoredMask) and term_count(mask).terms <= _MOST_TERMS


def other_models(mask: AbstractMask) -> str:
    """The wave models that take the mask, in words."""
    exact = f"{mask.exact_model!r}, " if mask.exact_model else ""
    return f"{exact}'angular_spectrum' or 'rayleigh_sommerfeld'"


class ZoneOrders(Module):
    """The unbounded zone plate Σ_k c_k e^{jkβr²}, and the width of the aperture that bounds it.

    - `orders`: the k.
    - `coefficients`: the c_k, complex.
    - `beta`: β, rad/mm².
    - `width`: mm, along x.
    """

    orders: tuple[int, ...] = eqx.field(static=True)
    coefficients: Complex[Array, " order"]
    beta: Float[Array, ""] = eqx.field(converter=unchecked("rad/mm^2"))
    width: Float[Array, ""] = eqx.field(converter=unchecked("mm"))


def zone_orders(mask: AbstractMask) -> ZoneOrders | None:
    """The orders of a printed zone plate; None of any other mask, one on a display included."""
    orders = getattr(mask, "zone_orders", None)
    return None if orders is None or getattr(mask, "pixels", None) is not None else orders()


def require_zone_orders(mask: AbstractMask, model: str) -> ZoneOrders:
    """The mask's zone orders, or one line that says which models can be used without."""
    orders = zone_orders(mask)
    if orders is not None:
        return orders
    instead = other_models(mask)
    if hasattr(mask, "zone_orders"):
        raise ValueError(
            f"{model!r} has no display pixels; drop pixel_pitch from the mask, or use {instead}"
        )
    raise TypeError(
        f"{model!r} needs the continuous zones of a FresnelZoneAperture; for a "
        f"{type(mask).__name__} use {instead}"
    )


def pairs(
    coefficients: Complex[Array, " term"],
) -> tuple[np.ndarray, np.ndarray, Complex[Array, " pair"]]:
    """All pairs k ≤ l of terms and their weights, so that |Σ c_k A_k|² = Re Σ w_kl A_k A_l*."""
    first, second = np.triu_indices(coefficients.shape[0])
    double = np.where(first == second, 1.0, 2.0).astype(coefficients.dtype)
    return first, second, coefficients[first] * coefficients[second].conj() * double
