"""A distance for every pixel, and one picture in which everything is sharp."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.depth.focus import Measure, focus_measure, gaussian_average
from thincam_jax.reconstruction.depth.refocus import RefocusSweep

_FAINT = 0.02  # of the strongest focus: below, a pixel shows noise rather than a picture


class DepthMap(eqx.Module):
    """Distances per pixel.

    - `distance`: mm, (*batch, y, x), where the focus measure around the pixel is largest.
    - `confidence`: from 0 to 1: how far the largest stands above the least of the sweep, relative
      to itself, times how strong it is; even surfaces and the dark ground have little.
    """

    distance: Float[Array, "*batch y x"]
    confidence: Float[Array, "*batch y x"]


def depth_map(
    sweep: RefocusSweep,
    *,
    measure: Measure = "laplacian_variance",
    smoothing: float | int = 1.0,
    window: float | int = 6.0,
) -> DepthMap:
    """The distance at which the surroundings of each pixel are sharpest.

    `window` is the standard deviation of the surroundings in pixels: a smaller one follows the
    objects' outlines, a larger one is less noisy. The maximum is placed between the steps by a
    parabola over 1/t. Confidence is that of "laplacian_variance" or "gradient_energy";
    "gradient_sparsity" measures no strength and calls noise a picture.
    """
    focus = focus_measure(sweep.images, measure, smoothing=smoothing, window=window)
    return DepthMap(*_largest(focus, sweep.distances))


@jax.jit
def _largest(focus, distances):
    focus = jnp.maximum(focus, 0)  # a variance, up to rounding
    place = jnp.argmax(focus, axis=0)
    inner = jnp.clip(place, 1, len(distances) - 2)

    def at(offset: int):
        index = inner + offset
        return _taken(focus, index), (1 / distances)[index]

    (before, u0), (middle, u1), (after, u2) = at(-1), at(0), at(1)
    left, right = u1 - u0, u2 - u1
    fall, rise = (middle - before) / left, (middle - after) / right
    curvature = fall + rise
    is_peak = (place == inner) & (jnp.abs(curvature) > 0)
    shift = (fall * right - rise * left) / (2 * jnp.where(is_peak, curvature, 1))
    distance = jnp.where(is_peak, 1 / (u1 + jnp.where(is_peak, shift, 0)), distances[place])
    peak, least = jnp.max(focus, axis=0), jnp.min(focus, axis=0)
    floor = _FAINT * jnp.max(peak)
    strength = peak / jnp.where(peak + floor > 0, peak + floor, 1)
    contrast = 1 - least / jnp.where(peak > 0, peak, 1)
    return distance, jnp.where(peak > 0, contrast * strength, 0)


def all_in_focus(
    sweep: RefocusSweep, depth: DepthMap, *, smoothing: float | int = 8.0
) -> Float[Array, "*batch y x"]:
    """One picture, each pixel from the image focused on its distance.

    Distances of little confidence are replaced by those around: the average of 1/t over `smoothing`
    pixels, weighted by confidence squared. Between two images of the sweep it is linear in 1/t.
    """
    weight = depth.confidence**2 + 1e-6
    inverse = gaussian_average(weight / depth.distance, smoothing)
    inverse = inverse / gaussian_average(weight, smoothing)
    return _picked(sweep.images, sweep.distances, inverse)


@jax.jit
def _picked(images, distances, inverse):
    u = 1 / distances  # falling
    after = jnp.clip(jnp.searchsorted(-u, -inverse), 1, len(u) - 1)
    share = jnp.clip((u[after - 1] - inverse) / (u[after - 1] - u[after]), 0, 1)
    near, far = _taken(images, after - 1), _taken(images, after)
    return (1 - share) * near + share * far


def _taken(stack, index):
    """Of a stack (n, …), the entry `index` (…) at each pixel."""
    return jnp.take_along_axis(stack, index[None], axis=0)[0]
