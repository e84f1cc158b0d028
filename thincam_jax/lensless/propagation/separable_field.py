r"""`separable` of a mask of many terms: its Fresnel field as one matrix product."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import product
from thincam_jax.lensless.masks.base import AbstractFactoredMask, MaskTerms
from thincam_jax.lensless.propagation.lattice import pixel_mean
from thincam_jax.lensless.propagation.path import LightPath
from thincam_jax.lensless.propagation.separable import axis_fields, cell_shadows


def separable_image(
    mask: AbstractFactoredMask, grid: Grid, path: LightPath, *, nodes: int | None
) -> Float[Array, "y x"]:
    r"""PSF of a mask of K terms, |Σ_k c_k A_k(x) B_k(y)|² summed before it is squared.

    The same field as `separable`'s, at 8K operations a pixel in place of the 2K² of its products.
    A pixel's average is the mean over `nodes` points of it, None for its centre. They are a rank-1
    lattice: as many different rows and columns as there are points, since the waves of the edges
    along one axis are fine along the other only. It is off by some 0.35/nodes of the PSF, where
    pixels hold many fringes, against 1/√nodes of a square of as many Gauss nodes.
    """
    terms = mask.terms(path.wavelength)
    y, x = path.on_mask(grid, mask.centre)
    along_y, along_x = path.along_axes(mask.centre)
    pitch = grid.pitch / path.magnification
    cells = None if terms.rows.curvatures is not None else _cells(terms)

    @jax.checkpoint
    def irradiance(place: Float[Array, "2"]) -> Float[Array, "y x"]:
        down, across = y + place[0] * pitch, x + place[1] * pitch
        if cells is None:
            rows = terms.coefficients[:, None] * axis_fields(terms.rows, along_y, down)
            columns = axis_fields(terms.columns, along_x, across)
        else:
            rows = _cell_fields(terms.rows.edges, along_y, down)
            columns = _cell_fields(terms.columns.edges, along_x, across)
            if len(rows) <= len(columns):
                columns = product(cells, columns)
            else:
                rows = product(cells.T, rows)
        return _square_of_product(rows, columns)

    if nodes is None:
        return irradiance(jnp.zeros(2, x.dtype))
    return pixel_mean(irradiance, nodes, jnp.zeros(grid.shape, x.dtype))


def _cells(terms: MaskTerms) -> Complex[Array, "row column"]:
    """The mask's transmittance in each pair of cells."""
    return product(terms.rows.values.T * terms.coefficients, terms.columns.values)


def _cell_fields(
    edges: Float[Array, " edge"], path: LightPath, x: Float[Array, " n"]
) -> Complex[Array, "cell n"]:
    """Field of each open cell alone, along one axis; see `axis_fields`."""
    lit, waves = cell_shadows(edges, path, x)
    field = lit * (1 + 1j) + waves[:-1] - waves[1:]
    return field * jnp.asarray(np.sqrt(0.5), field.dtype)


def _square_of_product(
    rows: Complex[Array, "k y"], columns: Complex[Array, "k x"]
) -> Float[Array, "y x"]:
    """|rowsᵀ columns|² by three real products, which processors do faster than complex ones."""
    first = product(rows.real.T, columns.real)
    second = product(rows.imag.T, columns.imag)
    both = product((rows.real + rows.imag).T, columns.real + columns.imag)
    return (first - second) ** 2 + (both - first - second) ** 2
