r"""`separable` of a zone plate lit from a point off both of its axes: chirps cut off by edges."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, phasor, product
from thincam_jax.lensless.masks.base import AbstractMask, zone_orders
from thincam_jax.lensless.propagation.chirp import chirp_integral
from thincam_jax.lensless.propagation.lattice import pixel_mean
from thincam_jax.lensless.propagation.path import Path

# Points a pixel for its average: off by some 0.35 over that, where a pixel holds many fringes.
PIXEL_POINTS = 13
# What the axes may share of an order's curvature, 1 where it focuses along a line.
_MOST_SHARED = 0.25
# Of the interpolation across the shear.
_NODES = 32


def focuses_on_a_line(mask: AbstractMask, path: Path) -> bool:
    """Whether `skew_image` refuses a point off both axes; False where that is not known yet."""
    if checks.holds_traced(mask, path):
        return False
    with jax.ensure_compile_time_eval():
        zones, ray = zone_orders(mask), path.chief_ray(mask.centre)
        return zones is not None and bool(_is_line(*_curvatures(zones, ray, path)))


def _curvatures(zones, ray, path: Path):
    """Entries (yy, xx, yx) of the matrix B, and kβ of the orders."""
    b = path.fresnel_curvature * ray.cosine
    matrix = (1 - ray.down**2) * b, (1 - ray.across**2) * b, -ray.down * ray.across * b
    return matrix, jnp.asarray(zones.orders, zones.beta.dtype) * zones.beta


def _is_line(matrix, curvatures) -> Bool[Array, ""]:
    shared = matrix[2] ** 2 / ((curvatures + matrix[0]) * (curvatures + matrix[1]))
    return jnp.max(jnp.abs(shared)) > _MOST_SHARED


def skew_image(
    mask: AbstractMask, grid: Grid, path: Path, *, nodes: int | None
) -> Float[Array, "y x"]:
    r"""PSF of a zone plate for a point off both axes, |Σ_k c_k U_k|².

    With the matrix B of `Path` and A_k = kβ I + B, the order k of the unbounded plate is

    .. math::
        \sqrt{\frac{\det B}{\det A_k}}\; e^{j k\beta\,\mathbf u^T A_k^{-1} B\,\mathbf u},

    and comes from the point :math:`\pmb\xi_k = A_k^{-1} B\,\mathbf u` of the mask. An edge
    cuts it off as it does with the curvature :math:`\alpha = A_{xx} - A_{xy}^2/A_{yy}`, which the
    waves have once they are integrated along the edge:

    .. math::
        U_k \approx \frac{\sqrt{\det B}}{j\pi} \sqrt{1 - \frac{A_{xy}^2}{A_{xx} A_{yy}}}\;
        e^{j k\beta\,\mathbf u^T \pmb\xi_k}
        \int e^{j\alpha_y(\eta - \eta_k)^2} d\eta \int e^{j\alpha_x(\xi - \xi_k)^2} d\xi.

    Exact for a plate without edges and for one edge alone; what is approximated are the waves of
    the four corners: 0.2 % of the PSF at 20° and azimuth 45°, 0.4 % at 30° (β = 25 rad/mm²,
    5.632 mm, d = 6.5 mm). Where an order focuses into a line nearly along an axis the corners
    count, and the numbers are refused inside jit; outside, `psf` samples them. A pixel's average
    is the mean over `nodes` points of it, None for its centre.
    """
    zones = zone_orders(mask)
    ray = path.chief_ray(mask.centre)
    if zones is None or ray is None:
        raise TypeError(
            f"model 'separable' has a {type(mask).__name__} for points on one of its axes only; "
            "give at = (y, 0) or (0, x), or model = 'angular_spectrum'"
        )
    matrix, curvatures = _curvatures(zones, ray, path)
    curvatures = eqx.error_if(
        curvatures,
        _is_line(matrix, curvatures),
        "model 'separable' has no PSF for a point off both axes where an order focuses nearly on "
        "the sensor; use 'angular_spectrum'",
    )
    y, x = path.on_mask(grid, mask.centre)
    pitch = grid.pitch / path.magnification

    @jax.checkpoint
    def irradiance(place: Float[Array, "2"]) -> Float[Array, "y x"]:
        down, across = y + place[0] * pitch, x + place[1] * pitch

        def added(field, order):
            g, weight = order
            wave = weight * _order(g, matrix, mask.extent, down, across)
            return field + wave.astype(field.dtype), None  # the light's own may be wider

        none = jnp.zeros(grid.shape, zones.coefficients.dtype)
        field, _ = jax.lax.scan(added, none, (curvatures, zones.coefficients))
        return field.real**2 + field.imag**2

    if nodes is None:
        return irradiance(jnp.zeros(2, x.dtype))
    return pixel_mean(irradiance, nodes, jnp.zeros(grid.shape, zones.beta.dtype))


def _order(g, matrix, extent, y: Float[Array, " y"], x: Float[Array, " x"]):
    """U_k of the curvature g = kβ at every pair of y and x."""
    yy, xx, yx = matrix
    top, side = g + yy, g + xx
    determinant = top * side - yx**2
    own_y, own_x, shear = (
        1 - g * side / determinant,
        1 - g * top / determinant,
        g * yx / determinant,
    )
    height, width = extent
    rows = _sheared(determinant / side, height, own_y, shear, y, x)
    columns = _sheared(determinant / top, width, own_x, shear, x, y).T
    phases = g * own_y * y[:, None] ** 2 + g * own_x * x**2 + 2 * g * shear * y[:, None] * x
    size = jnp.sqrt((yy * xx - yx**2) * jnp.abs(determinant / (top * side))) / np.pi
    return as_complex(size) * phasor(phases) * rows * columns


def _sheared(
    alpha: Float[Array, ""],
    width: Float[Array, ""],
    own: Float[Array, ""],
    shear: Float[Array, ""],
    along: Float[Array, " m"],
    other: Float[Array, " n"],
) -> Complex[Array, "m n"]:
    """∫ e^{jα(ξ − ξ₀)²} dξ over the aperture, ξ₀ = own·along + shear·other.

    The shear is some micrometres: it is interpolated in `other` by Chebyshev's polynomials.
    """
    nodes, weights = _interpolation(len(other))
    places = other[0] + (other[-1] - other[0]) * jnp.asarray(nodes, other.dtype)
    values = chirp_integral(
        jnp.zeros_like(alpha), alpha, own * along[:, None] + shear * places, -width / 2, width / 2
    )
    return product(values, as_complex(jnp.asarray(weights, other.dtype)))


@functools.lru_cache
def _interpolation(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places of the nodes, 0 to 1 from the first sample to the last, and (node, sample) weights."""
    angles = (np.arange(_NODES) + 0.5) * np.pi / _NODES
    nodes, samples = np.cos(angles), np.linspace(-1, 1, count)
    orders = np.arange(_NODES)
    weights = np.cos(np.outer(angles, orders)) @ np.cos(np.outer(orders, np.arccos(samples)))
    return (nodes + 1) / 2, (2 * weights - 1) / _NODES
