r"""Sampled fields in one dimension.

In the Fresnel approximation the field of a separable mask stays separable, so that a sampled
propagation is, but for the cross term of the exact phase, the product of two one-dimensional ones:
the same samples, window, band limit and rounding at the cost of an axis.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core.grids import Grid, centred_frequencies, centred_indices
from thincam_jax._core.precision import as_complex, turn_phasor
from thincam_jax.lensless.accuracy.points import Points
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.fza import axis_samples
from thincam_jax.lensless.propagation.angular_spectrum import padded_shape, planes, propagate
from thincam_jax.lensless.propagation.orders import pairs, require_zone_orders
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.propagation.plane import spherical_wave
from thincam_jax.lensless.propagation.separable_sum import SeparableSum


@functools.partial(
    jax.jit, static_argnames=("shape", "pixel_integration", "mask_shape", "oversampling")
)
def angular_spectrum_terms(
    mask: AbstractMask,
    points: Points,
    path: Path,
    *,
    shape: tuple[int, int],
    pixel_integration: bool,
    mask_shape: tuple[int, int],
    oversampling: int,
) -> SeparableSum:
    """The PSF of `angular_spectrum` at some rows and columns of a grid of `shape`, as a product."""
    zones = require_zone_orders(mask, "angular_spectrum")
    lower, upper, weights = pairs(zones)
    plane, sensor = planes(Grid(shape, points.pitch), mask_shape, oversampling)
    half = oversampling // 2 if pixel_integration else 0
    factors = []
    for axis, indices in enumerate((points.row_indices, points.column_indices)):
        samples, line = plane.shape[axis], Grid((1, plane.shape[axis]), plane.pitch)
        values = axis_samples(zones, line.x - mask.centre[axis], line.pitch)
        lit = values * spherical_wave(line, path)
        # Sensor samples of the chosen pixels, counted from the axis.
        fine = indices[:, None] * oversampling + jnp.arange(-half, half + 1, dtype=indices.dtype)
        across = sensor.shape[axis]
        size = padded_shape((samples, samples), (across, across), 2.0)[0]
        fields = _by_transform(lit, plane.pitch, path, size, fine.ravel())
        fields = fields.reshape(len(zones.orders), *fine.shape)
        fields = fields * as_complex(jnp.sqrt(path.magnification))
        factors.append(jnp.mean(fields[lower, :] * jnp.conj(fields[upper, :]), axis=-1))
    return SeparableSum(weights[:, None] * factors[0], factors[1], points)


def _by_transform(lit, pitch, path: Path, size: int, fine) -> Complex[Array, "order n"]:
    """Propagated on a window of `size` samples, taken where `fine` samples lie."""
    count = lit.shape[-1]
    padded = jnp.pad(lit, ((0, 0), (0, size - count)))
    window = jax.vmap(lambda line: propagate(line[None], pitch, path)[0])(padded)
    position = jnp.round(fine + (count - 1) / 2).astype(jnp.int32) % size
    return window[:, position]


@functools.partial(jax.jit, static_argnames="samples")
def fine_fields(
    mask: AbstractMask, path: Path, reach: Float[Array, ""], exact: Bool[Array, ""], samples: int
) -> Complex[Array, "order n"]:
    r"""Fields of the orders on a line, finely sampled, over ±`reach` about the axis.

    `exact` takes the exact phases of the spherical wave and of the propagation, which Fresnel's
    approximation replaces by :math:`\pi\xi^2/(\lambda t)` and :math:`-\pi\lambda d u^2`; the
    difference of the two is what the approximation costs, while the sampling is common to both.
    """
    zones = require_zone_orders(mask, "separable")
    pitch = 4 * reach / samples  # as much again on both sides, so that nothing wraps round
    x = centred_indices(samples, pitch.dtype) * pitch
    values = axis_samples(zones, x, pitch)
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
