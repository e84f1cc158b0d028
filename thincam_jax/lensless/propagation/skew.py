r"""`separable` of a zone plate lit from a point off both of its axes: chirps cut off by edges."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, phasor, product, squared_modulus
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractMask, pairs, zone_orders
from thincam_jax.lensless.propagation.chirp import chirp_integral

# What the axes may share of an order's curvature, 1 where it focuses along a line.
_MOST_SHARED = 0.25
# Error that corners leave, for a zone of an edge as wide as the mask and axes that share all: of 22
# random plates at most 1.4.
_CORNERS = 1.6
# Of the interpolation across the shear; where a pixel's average leaves little of far edges' waves,
# those of the first orders need fewer.
_NODES, _FEW_NODES = 32, 16
# Numbers of the terms of an image that are held together.
_AT_ONCE = 2**19


def focuses_on_a_line(mask: AbstractMask, path: LightPath) -> bool:
    """Whether `skew_image` refuses a point off both axes; False where that is not known yet."""
    if checks.holds_traced(mask, path):
        return False
    with jax.ensure_compile_time_eval():
        zones, ray = zone_orders(mask), path.chief_ray(mask.centre)
        return zones is not None and bool(_shared(*_curvatures(zones, ray, path)) > _MOST_SHARED)


def _curvatures(zones, ray, path: LightPath):
    """Entries (yy, xx, yx) of the matrix B, and kβ of the orders."""
    b = path.fresnel_curvature * ray.cosine
    matrix = (1 - ray.down**2) * b, (1 - ray.across**2) * b, -ray.down * ray.across * b
    return matrix, jnp.asarray(zones.orders, zones.beta.dtype) * zones.beta


def _shared(matrix, curvatures) -> Float[Array, ""]:
    """Largest part of an order's curvature that the axes share."""
    shared = matrix[2] ** 2 / ((curvatures + matrix[0]) * (curvatures + matrix[1]))
    return jnp.max(jnp.abs(shared))


def corner_error(mask: AbstractMask, path: LightPath, pixel: float) -> float:
    r"""Relative error of `skew_image`, about at most, by the waves of the mask's corners.

    They have another phase beyond a distance of :math:`l = z\sigma^{-1/4}` from both edges, with
    :math:`z^2 = \lambda d/M` and :math:`\sigma = A_{xy}^2/A_{xx}A_{yy}`: of a plate w wide that
    is :math:`z^2/lw` of the PSF, and :math:`z^2/\pi lp` of this in averages over p (`pixel`).
    """
    zones, ray = zone_orders(mask), path.chief_ray(mask.centre)
    if zones is None or ray is None:
        return 0.0
    shared = _shared(*_curvatures(zones, ray, path)) ** 0.25
    reached = jnp.sqrt(np.pi / path.fresnel_curvature) * shared  # z²/l
    kept = jnp.minimum(1.0, reached / (np.pi * pixel)) if pixel else 1.0
    return float(_CORNERS * reached / jnp.minimum(*mask.extent) * kept)


def skew_image(
    mask: AbstractMask, grid: Grid, path: LightPath, *, nodes: int | None
) -> Float[Array, "y x"]:
    r"""PSF of a zone plate for a point off both axes, |Σ_k c_k U_k|².

    With the matrix B of `LightPath` and A_k = kβ I + B, the order k of the unbounded plate is

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
    count, and the numbers are refused inside jit; outside, `psf` samples them. Within a pixel the
    waves are products of the axes' own, since the shear of ξ_k and η_k is some nanometres there:
    its average, by `nodes` Gauss nodes an axis, None for its centre, is a product for each pair of
    orders.
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
        _shared(matrix, curvatures) > _MOST_SHARED,
        "model 'separable' has no PSF for a point off both axes where an order focuses nearly on "
        "the sensor; use 'angular_spectrum'",
    )
    y, x = path.on_mask(grid, mask.centre)
    (yy, xx, yx), (height, width), g = matrix, mask.extent, curvatures
    top, side = g + yy, g + xx
    determinant = top * side - yx**2
    size = jnp.sqrt((yy * xx - yx**2) * jnp.abs(determinant / (top * side))) / np.pi
    coefficients, shear = zones.coefficients * as_complex(size), g * yx / determinant
    few = _NODES if nodes is None or max(zones.orders) > 1 else _FEW_NODES
    rows = _Axis(g, determinant / side, 1 - g * side / determinant, shear, height, y, x, few)
    columns = _Axis(g, determinant / top, 1 - g * top / determinant, shear, width, x, y, few)
    if nodes is None:
        middle = jnp.zeros((), y.dtype)
        waves = coefficients[:, None, None] * rows.waves(middle)
        return _image(waves, columns.waves(middle), squared_modulus)
    places, shares = leggauss(nodes)
    half = grid.pitch / path.magnification / 2
    offsets = jnp.asarray(places, y.dtype) * half
    shares = as_complex(jnp.asarray(shares / 2, y.dtype))[:, None, None, None]
    lower, upper, weights = pairs(coefficients)

    def average(axis: _Axis) -> Complex[Array, "pair n node"]:
        # One node after another, see `separable`.
        waves = jax.lax.map(jax.checkpoint(lambda offset: axis.waves(offset)), offsets)
        return jnp.sum(shares * waves[:, lower] * waves[:, upper].conj(), axis=0)

    return _image(weights[:, None, None] * average(rows), average(columns), jnp.real)


class _Axis(eqx.Module):
    """One axis' factors of the orders' waves, with ξ₀ = own·along + shear·other.

    The shear is some micrometres: they are interpolated in `other` by Chebyshev's polynomials.
    """

    curvatures: Float[Array, " order"]
    alpha: Float[Array, " order"]
    own: Float[Array, " order"]
    shear: Float[Array, " order"]
    width: Float[Array, ""]
    along: Float[Array, " n"]
    other: Float[Array, " m"]
    nodes: int = eqx.field(static=True)

    def waves(self, offset: Float[Array, ""]) -> Complex[Array, "order n node"]:
        """∫ e^{jα(ξ − ξ₀)²} dξ over the aperture, at an offset from each place, with its phase.

        Of the phase that the axes share, each has half in the middle of a pixel.
        """
        orders = self.curvatures, self.alpha, self.own, self.shear
        g, alpha, own, shear = (each[:, None, None] for each in orders)
        nodes = jnp.asarray(_interpolation(len(self.other), self.nodes)[0], self.other.dtype)
        sheared = shear * (self.other[0] + (self.other[-1] - self.other[0]) * nodes)
        place = self.along[:, None] + offset
        half, origin = self.width / 2, own * place + sheared
        integral = chirp_integral(jnp.zeros_like(alpha), alpha, origin, -half, half)
        return integral * phasor(g * (own * place**2 + sheared * (place + offset)))


def _image(
    rows: Complex[Array, "term y node"],
    columns: Complex[Array, "term x node"],
    form: Callable[[Complex[Array, " x"]], Float[Array, " x"]],
) -> Float[Array, "y x"]:
    """A form of the sum of the products of both axes' factors, some rows of the image at a time."""
    count, height, nodes = rows.shape
    width = columns.shape[1]
    down, across = (
        jnp.asarray(_interpolation(n, nodes)[1], rows.real.dtype) for n in (height, width)
    )
    parts = jnp.concatenate([columns.real, columns.imag]).reshape(-1, nodes).T

    @jax.checkpoint
    def row(given):
        factors, place = given
        real, imaginary = jnp.split(
            product(jnp.concatenate([factors.real, factors.imag]), across), 2
        )
        other = product(place, parts).reshape(2, count, width)
        return form(
            jnp.sum(jax.lax.complex(real, imaginary) * jax.lax.complex(other[0], other[1]), 0)
        )

    at_once = max(1, _AT_ONCE // (count * width))
    return jax.lax.map(row, (jnp.swapaxes(rows, 0, 1), down.T), batch_size=at_once)


@functools.lru_cache
def _interpolation(count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Places of the nodes, 0 to 1 from the first sample to the last, and (node, sample) weights."""
    angles = (np.arange(size) + 0.5) * np.pi / size
    nodes, samples = np.cos(angles), np.linspace(-1, 1, count)
    orders = np.arange(size)
    weights = np.cos(np.outer(angles, orders)) @ np.cos(np.outer(orders, np.arccos(samples)))
    return (nodes + 1) / 2, (2 * weights - 1) / size
