r"""Some rows and columns of a grid that stand for all of them, and sampled fields on them.

In the Fresnel approximation the field of a separable mask stays separable, so that a sampled
propagation is, but for the cross term of the exact phase, the product of two one-dimensional ones:
the same samples, window, band limit and rounding at the cost of an axis.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from thincam_jax._core.grids import Grid, SparseGrid, centred_frequencies, centred_indices
from thincam_jax._core.precision import as_complex, turn_phasor
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractFactoredMask, pairs
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.propagation.angular_spectrum import (
    padded_shape,
    planes,
    propagate,
    spherical_wave,
)
from thincam_jax.lensless.propagation.separable import SeparableSum

# Rows and columns that are looked at. All sizes have this many, so that nothing recompiles.
COUNT = 256
# Share of them that may lie at the shadow's two edges, where the fields change fastest.
_AT_EDGES = 0.5


def chosen(
    count: int, edges: tuple[float, float], zone: float, seed: int
) -> tuple[Int[np.ndarray, " chosen"], Float[np.ndarray, " chosen"]]:
    """Indices out of `count`, and how many of them each stands for.

    Everything if it is few enough; else a stratified random choice that is denser within `zone`
    (in samples) of the `edges` (indices, which may lie outside). Filled up with weight zero.
    """
    if count <= COUNT:
        filled = np.zeros(COUNT, int)
        filled[:count] = np.arange(count)
        return filled, (np.arange(COUNT) < count).astype(float)
    indices = np.arange(count)
    distance = np.min([np.abs(indices - edge) for edge in edges], axis=0)
    near = distance <= max(zone, 4.0)
    density = np.full(count, COUNT * (1 - _AT_EDGES) / count)
    if near.any():
        density[near] = np.minimum(1.0, density[near] + COUNT * _AT_EDGES / near.sum())
    density *= COUNT / density.sum()
    density = np.minimum(density, 1.0)
    # One of each stratum of equal total density.
    total = np.cumsum(density)
    offsets = np.random.default_rng(seed).uniform(size=COUNT)
    strata = (np.arange(COUNT) + offsets) * total[-1] / COUNT
    found = np.minimum(np.searchsorted(total, strata), count - 1)
    return found, total[-1] / (COUNT * density[found])


@jax.jit(static_argnames=("shape", "method"))
def angular_spectrum_terms(
    mask: AbstractFactoredMask,
    points: SparseGrid,
    path: LightPath,
    shape: tuple[int, int],
    method: PsfMethod,
) -> SeparableSum:
    """The PSF of `angular_spectrum` at some rows and columns of a grid of `shape`, as a product."""
    terms = mask.terms(path.wavelength)
    lower, upper, weights = pairs(terms.coefficients)
    plane, sensor = planes(Grid(shape, points.pitch), method)
    half = method.samples // 2 if method.pixel_integration else 0
    factors = []
    both = (terms.rows, points.row_indices), (terms.columns, points.column_indices)
    for axis, (along, indices) in enumerate(both):
        samples, line = plane.shape[axis], Grid((1, plane.shape[axis]), plane.pitch)
        values = along.samples(line.x - mask.centre[axis], line.pitch)
        lit = values * spherical_wave(line, path)
        # Sensor samples of the chosen pixels, counted from the axis.
        fine = indices[:, None] * method.samples + jnp.arange(-half, half + 1, dtype=indices.dtype)
        across = sensor.shape[axis]
        size = padded_shape((samples, samples), (across, across), 2.0)[0]
        fields = _by_transform(lit, plane.pitch, path, size, fine.ravel())
        fields = fields.reshape(-1, *fine.shape)
        fields = fields * as_complex(jnp.sqrt(path.magnification))
        factors.append(jnp.mean(fields[lower, :] * jnp.conj(fields[upper, :]), axis=-1))
    return SeparableSum(weights[:, None] * factors[0], factors[1], points)


def _by_transform(lit, pitch, path: LightPath, size: int, fine) -> Complex[Array, "order n"]:
    """Propagated on a window of `size` samples, taken where `fine` samples lie."""
    count = lit.shape[-1]
    padded = jnp.pad(lit, ((0, 0), (0, size - count)))
    window = jax.vmap(lambda line: propagate(line[None], pitch, path)[0])(padded)
    position = jnp.round(fine + (count - 1) / 2).astype(jnp.int32) % size
    return window[:, position]


@functools.partial(jax.jit, static_argnames=("samples", "axis"))
def fine_fields(
    mask: AbstractFactoredMask,
    path: LightPath,
    reach: Float[Array, ""],
    exact: Bool[Array, ""],
    samples: int,
    axis: int = 1,
) -> Complex[Array, "order n"]:
    r"""Fields of the terms on a line along x (or y, axis 0), finely sampled, over ±`reach`.

    `exact` takes the exact phases of the spherical wave and of the propagation, which Fresnel's
    approximation replaces by :math:`\pi\xi^2/(\lambda t)` and :math:`-\pi\lambda d u^2`; the
    difference of the two is what the approximation costs, while the sampling is common to both.
    """
    terms = mask.terms(path.wavelength)
    factors = terms.columns if axis else terms.rows
    pitch = 4 * reach / samples  # as much again on both sides, so that nothing wraps round
    x = centred_indices(samples, pitch.dtype) * pitch
    values = factors.samples(x, pitch)
    parabolic = turn_phasor(x**2 / (2 * path.wavelength * path.object_distance))
    wave = jnp.where(exact, spherical_wave(Grid((1, samples), pitch), path)[0], parabolic)
    u = jnp.fft.ifftshift(centred_frequencies(samples, pitch))
    s = (path.wavelength * u) ** 2
    carried = s < 1
    bent = 1 + jnp.where(exact, jnp.sqrt(jnp.where(carried, 1 - s, 1.0)), 1.0)
    turns = -(path.distance / path.wavelength) * jnp.where(carried, s, 0.0) / bent
    transfer = jnp.where(carried, turn_phasor(turns), 0.0)
    fields = jnp.fft.ifft(jnp.fft.fft(values * wave, axis=-1) * transfer, axis=-1)
    return fields[:, samples // 4 : samples - samples // 4]
