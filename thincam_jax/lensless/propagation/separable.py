"""`separable`: the exact Fresnel field of a mask of few separable terms, in closed form."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, DTypeLike, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, product, turn_phasor
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AxisFactors, MaskTerms, pairs
from thincam_jax.lensless.method import PIXEL_NODES
from thincam_jax.lensless.propagation.chirp import chirp_integral, edge_wave


class SeparableSum(eqx.Module):
    """The image Σ_m Re{ Y_m(y) X_m(x) }.

    A PSF of a square Fresnel zone aperture has this form with a handful of terms, because |U|² of
    a sum of separable fields is again one. Image, pixel average and OTF then cost one-dimensional
    work and one real matrix product, in place of two-dimensional transforms.

    - `rows`: Y_m on the rows, with all constant factors.
    - `columns`: X_m on the columns.
    - `grid`: grid of the samples.
    """

    rows: Complex[Array, "term y"]
    columns: Complex[Array, "term x"]
    grid: Grid

    def image(self) -> Float[Array, "y x"]:
        """The image on the grid."""
        rows, columns = self.real_factors()
        return product(rows.T, columns)

    def transform(self) -> Complex[Array, "v u"]:
        """Fourier transform ∬ h e^{−2πj(ux+vy)} dx dy on the grid's centred frequencies, mm².

        The integral over the sampled area, as the sum of the samples times pitch².
        """
        rows, columns = (_centred_dft(factor) for factor in self.real_factors())
        return product(rows.T, columns) * as_complex(self.grid.pitch**2)

    def real_factors(self) -> tuple[Float[Array, "factor y"], Float[Array, "factor x"]]:
        """Real Y_f and X_f with h = Σ_f Y_f(y) X_f(x), twice as many as there are terms."""
        # Re{YX} = Re Y Re X − Im Y Im X: one real product in place of a complex one.
        rows = jnp.concatenate([self.rows.real, -self.rows.imag])
        return rows, jnp.concatenate([self.columns.real, self.columns.imag])


@jax.jit
def image_of_terms(terms: SeparableSum, grid: Grid) -> Float[Array, "y x"]:
    """The image on a grid of terms on its rows and columns and beyond."""
    return _cut(terms, grid).image()


@jax.jit
def transform_of_terms(terms: SeparableSum, grid: Grid) -> Complex[Array, "v u"]:
    """The transform of `image_of_terms`."""
    return _cut(terms, grid).transform()


def _cut(terms: SeparableSum, grid: Grid) -> SeparableSum:
    rows, columns = grid.shape
    return SeparableSum(terms.rows[:, :rows], terms.columns[:, :columns], grid)


def _centred_dft(samples: Float[Array, "factor n"]) -> Complex[Array, "factor n"]:
    """Σ_i f_i e^{−2πj u (i−(n−1)/2)}, zero frequency at n//2."""
    n = samples.shape[-1]
    spectrum = jnp.fft.fftshift(jnp.fft.fft(samples, axis=-1), axes=-1)
    return spectrum * centre_phase(n, samples.dtype)


def centre_phase(count: int, dtype: DTypeLike) -> Complex[Array, " count"]:
    """e^{2πj u (n−1)/2} on the centred DFT frequencies: moves the origin to the grid's centre."""
    turns = (jnp.arange(count, dtype=dtype) - count // 2) * ((count - 1) / (2 * count))
    return turn_phasor(turns)


# Rows and columns up to which a core computes both as fast as two.
_SMALL = 1024


@jax.jit
def axis_fields(
    factors: AxisFactors, path: LightPath, x: Float[Array, " n"]
) -> Complex[Array, "term n"]:
    r"""One-dimensional factor of every term's field, relative to the open aperture.

    .. math::
        A_k(x) = \sqrt{\frac{M}{\lambda d}} \int F_k(\xi) e^{jb(x/M-\xi)^2}\,d\xi,
        \qquad b = \frac{\pi M}{\lambda d}

    for the factor F_k of the mask, in Fresnel integrals. Of a chirp (`chirp_integral`) the term
    with g + b = 0 focuses on the sensor and is a sinc. Of constant cells it is the shadow and the
    wave of every edge, times the step of F_k there (`edge_wave`): one Fresnel integral an edge for
    all terms. `x` is given on the mask's scale, x/M. Written with the spherical wave's curvature,
    :math:`\pi\xi^2/(\lambda t) + \pi(x-\xi)^2/(\lambda d)`, every term would carry the phase
    πx²/(λ(t+d)) that all share: large where t is short.
    """
    b = path.fresnel_curvature
    edges, values = factors.edges, factors.values
    if factors.curvatures is None:
        lit, edge_waves = cell_shadows(edges, path, x)
        steps = jnp.diff(values, axis=1, prepend=0, append=0)
        root_half = np.sqrt(0.5)
        shadow = product(values, lit)
        waves = product(steps, edge_waves)
        return (shadow * (1 + 1j) + waves) * jnp.asarray(root_half, values.dtype)
    g = factors.curvatures[:, None, None]
    origins = 0.0 if factors.origins is None else factors.origins
    lower, upper = edges[:-1] - origins, edges[1:] - origins
    field = chirp_integral(g, b, x[:, None] - origins, lower, upper)
    field = (values[:, None] * field).sum(axis=-1)
    return field * as_complex(jnp.sqrt(path.magnification / (path.wavelength * path.distance)))


def cell_shadows(
    edges: Float[Array, " edge"], path: LightPath, x: Float[Array, " n"]
) -> tuple[Complex[Array, "cell n"], Complex[Array, "edge n"]]:
    """Shadows of constant cells: where each is lit, and the wave of each edge (`edge_wave`)."""
    offset = -path.detour(x - edges[:, None])
    lit = (offset[:-1] < 0) & (offset[1:] >= 0)  # as the waves' own steps have it
    return as_complex(lit.astype(x.dtype)), edge_wave(path.fresnel_curvature, offset)


def separable(
    mask: AbstractFactoredMask,
    grid: Grid,
    path: LightPath,
    *,
    pixel_integration: bool = True,
    nodes: int = PIXEL_NODES,
) -> SeparableSum:
    r"""PSF of a mask of separable terms: of a zone plate's orders, or of cells.

    .. math::
        h = \Big|\sum_k c_k A_k(x) B_k(y)\Big|^2
          = \sum_k |c_k|^2 |A_k|^2|B_k|^2
          + 2\,\mathrm{Re} \sum_{k<l} c_k c_l^* (A_k A_l^*)(x)\,(B_k B_l^*)(y)

    exact within the Fresnel approximation: no sampling condition, any grid, any distance. The
    paraxial phase that is left out is about πλ³dν⁴/4 at the spatial frequency ν of the field.
    n terms make n² real products: one for a pinhole, four for a redundant array, nine for the
    cosine profile, (harmonics + 2)² for the binary one, (2·harmonics + 1)² for the intensity's.

    `pixel_integration` averages each axis over the pixel by Gauss-Legendre quadrature with `nodes`
    nodes: the average of a separable term is separable.
    """
    terms = mask.terms(path.wavelength)
    down, across = terms.rows, terms.columns
    lower, upper, weights = pairs(terms.coefficients)
    scale = path.magnification

    def products(factors, path, x):
        if not pixel_integration:
            fields = axis_fields(factors, path, x)
            return fields[lower, :] * jnp.conj(fields[upper, :])
        places, node_weights = leggauss(nodes)
        offsets = jnp.asarray(places, dtype=x.dtype) * (grid.pitch / scale) / 2
        # One node after another: all at once, the compiler fuses the fields into the products and
        # computes them for each pair of orders. Gradients compute a node's field again, which is
        # faster than to store and load all that leads to it.
        one = jax.checkpoint(lambda offset: axis_fields(factors, path, x + offset))
        fields = jax.lax.map(one, offsets)
        average = as_complex(jnp.asarray(node_weights / 2, dtype=x.dtype))[:, None, None]
        return jnp.sum(average * fields[:, lower] * jnp.conj(fields[:, upper]), axis=0)

    y, x = path.on_mask(grid, mask.centre)
    along_y, along_x = path.along_axes(mask.centre)
    small = pixel_integration or sum(grid.shape) <= _SMALL
    if small and down is across and along_y is along_x:
        # Both axes at once: half as much to compile, and as fast.
        both = products(across, along_x, jnp.concatenate([y, x]))
        rows, columns = jnp.split(both, [grid.shape[0]], axis=-1)
    else:
        # One axis a core: a quarter faster.
        rows, columns = products(down, along_y, y), products(across, along_x, x)
    return SeparableSum(weights[:, None] * rows, columns, grid)


def pixel_mean(
    value: Callable[[Float[Array, "2"]], Float[Array, "y x"]], count: int, dark: Float[Array, "y x"]
) -> Float[Array, "y x"]:
    """Mean over `count` points of each pixel of the image at a point; `dark` is an image of 0."""
    places = jnp.asarray(lattice(count), dark.dtype)
    total, _ = jax.lax.scan(lambda total, place: (total + value(place), None), dark, places)
    return total / count


def lattice(count: int) -> Float[np.ndarray, "point 2"]:
    """Points (u, frac(g·u)), u = (i + ½)/count, of a rank-1 lattice about the pixel's centre.

    g is odd, has no divisor in common with the count and is next to count/golden ratio or its
    complement: of Fibonacci numbers, the best lattice (Niederreiter, CBMS-NSF 63 (1992), ch. 5).
    Odd, so that the points turned by 180° are the points.
    """
    golden = (math.sqrt(5) - 1) / 2 * count
    odd = [g for g in range(1, max(count, 2), 2) if math.gcd(g, count) == 1]
    generator = min(odd, key=lambda g: min(abs(g - golden), abs(count - g - golden)))
    first = (np.arange(count) + 0.5) / count
    return np.stack([first, first * generator % 1], axis=-1) - 0.5


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
