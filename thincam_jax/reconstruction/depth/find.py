"""Distances from a sweep of the focus: of objects, and of every pixel with a sharp picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
import skimage
from jaxtyping import Array, ArrayLike, Float, Int

from thincam_jax._core.arguments import checked
from thincam_jax.reconstruction.depth.focus import Measure, focus_measure, gaussian_average
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, increasing

_FAINT = 0.02  # of the strongest focus: below, a pixel shows noise rather than a picture


@dataclass(frozen=True)
class FocusPeak:
    """A maximum of a region's focus curve.

    - `region`: its label.
    - `distance`: mm, between the steps of the sweep.
    - `contrast`: how far the peak stands above the lowest value of the curve, relative to itself:
      0 for a flat curve.
    - `at_end`: the curve still rises at the end of the sweep. The object may stand outside of it;
      the distance is that of the end.
    """

    region: int
    distance: float
    contrast: float
    at_end: bool


@dataclass(frozen=True, eq=False)
class FocusCurves:
    """Focus measure of each region over the sweep, and its maxima.

    - `labels`: (region,), `curves`: (region, distance).
    - `peaks`: maxima of all regions in the order of the labels, each region's highest first.
    """

    labels: tuple[int, ...]
    curves: np.ndarray
    peaks: tuple[FocusPeak, ...]

    def distance_of(self, region: int) -> FocusPeak:
        """The highest peak of a region."""
        return next(peak for peak in self.peaks if peak.region == region)


@checked
def find_distances(
    sweep: RefocusSweep,
    *,
    measure: Measure = "laplacian_variance",
    smoothing: float | int = 1.0,
    regions: Int[np.ndarray, "y x"] | None = None,
    prominence: float | int = 0.15,
) -> FocusCurves:
    """Distances at which something in the sweep is in focus.

    A region's focus curve has a maximum at the distance of its object, found by the parabola
    through three points of the curve over 1/t, in which defocus is linear. Channels of a
    batch are averaged.

    **Arguments**

    - `regions`: whole numbers (y, x), 0 for the background; see `object_regions`. By default the
      whole field is one region (1): several objects are then found only if they are further apart
      than `axial_resolution`.
    - `prominence`: least prominence of a second maximum, relative to the curve's range; the highest
      is always given.
    - `measure`, `smoothing`: see `focus_measure`.

    Eager: the result holds plain numbers.
    """
    shape = sweep.images.shape[-2:]
    regions = np.ones(shape, dtype=int) if regions is None else np.asarray(regions)
    if regions.shape != shape:
        raise ValueError(f"regions has shape {regions.shape}; give labels of {shape} pixels")
    labels = tuple(int(n) for n in np.unique(regions) if n > 0)
    if not labels:
        raise ValueError("regions holds no label above 0; mark at least one object")
    distances = np.asarray(sweep.distances, dtype=float)
    curves, peaks = [], []
    for label in labels:
        found = focus_measure(
            sweep.images, measure, smoothing=smoothing, region=jnp.asarray(regions == label)
        )
        curve = np.asarray(found, dtype=float).reshape(len(distances), -1).mean(axis=1)
        curves.append(curve)
        peaks += _peaks(label, curve, distances, prominence)
    return FocusCurves(labels, np.stack(curves), tuple(peaks))


def _peaks(label: int, curve, distances, prominence: float | int) -> list[FocusPeak]:
    """Maxima of a curve, the highest first."""
    low, high = curve.min(), curve.max()
    least = max(prominence * (high - low), np.finfo(float).tiny)
    inner, _ = scipy.signal.find_peaks(curve, prominence=least)
    places = sorted({int(np.argmax(curve)), *map(int, inner)}, key=lambda k: -curve[k])
    ends = (0, len(curve) - 1)
    return [
        FocusPeak(
            label,
            float(distances[k]) if k in ends else vertex(curve, distances, k),
            float((curve[k] - low) / curve[k]) if curve[k] > 0 else 0.0,
            k in ends,
        )
        for k in places
    ]


def vertex(curve: np.ndarray, distances: np.ndarray, place: int) -> float:
    """Where the parabola over 1/t through a maximum and its neighbours is highest, mm."""
    u = 1 / distances[place - 1 : place + 2]
    before, after = (curve[place] - curve[place - 1]), (curve[place] - curve[place + 1])
    left, right = u[1] - u[0], u[2] - u[1]
    # Newton's form; steps of unequal length.
    curvature = before / left + after / right
    if not abs(curvature) > 0:
        return float(distances[place])
    shift = (before * right / left - after * left / right) / (2 * curvature)
    return float(1 / (u[1] + shift))


@checked
def object_regions(
    sweep: RefocusSweep,
    *,
    threshold: float | int = 0.25,
    smoothing: float | int | None = None,
    least: int | None = None,
) -> Int[np.ndarray, "y x"]:
    """Labels (y, x), from 1, of separate bright objects on a dark background.

    The mean of the sweep, smoothed, is cut at `threshold` of its highest value; regions are widened
    by the width of the smoothing, to include the objects' edges, which are the most informative.

    **Arguments**: `smoothing`, pixels, default 1.5 % of the field's diagonal; `least`, pixels of
    the smallest region kept, default 0.5 % of the field. Labels go from left to right.
    """
    images = sweep.images.reshape(-1, *sweep.images.shape[-2:])
    rows, columns = images.shape[-2:]
    width = 0.015 * float(np.hypot(rows, columns)) if smoothing is None else float(smoothing)
    mean = np.asarray(gaussian_average(jnp.mean(images, axis=0), width))
    widened = round(min(max(1, width), rows + columns))
    bright = scipy.ndimage.binary_dilation(mean > threshold * mean.max(), iterations=widened)
    found = np.asarray(skimage.measure.label(bright))
    count = int(found.max())
    smallest = 0.005 * rows * columns if least is None else least
    kept = [n for n in range(1, count + 1) if np.sum(found == n) >= smallest]
    kept.sort(key=lambda n: float(np.nonzero(found == n)[1].mean()))
    regions = np.zeros((rows, columns), dtype=int)
    for label, n in enumerate(kept, start=1):
        regions[found == n] = label
    return regions


class DepthMap(eqx.Module):
    """Distances per pixel.

    - `distance`: mm, (*batch, y, x), where the focus measure around the pixel is largest.
    - `confidence`: from 0 to 1: how far the largest stands above the least of the sweep, relative
      to itself, times how strong it is; uniform surfaces and the dark background have little.
    """

    distance: Float[Array, "*batch y x"]
    confidence: Float[Array, "*batch y x"]


@checked
def depth_map(
    sweep: RefocusSweep,
    *,
    measure: Measure = "laplacian_variance",
    smoothing: float | int = 1.0,
    window: float | int = 6.0,
) -> DepthMap:
    """The distance at which the neighbourhood of each pixel is sharpest.

    `window` is the standard deviation of the neighbourhood in pixels: a smaller one follows the
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


@checked
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


@checked
def depth_of_colours(
    images: Float[ArrayLike, "distance channel y x"], distances: Sequence[float | int]
) -> tuple[RefocusSweep, DepthMap, Float[Array, "channel y x"]]:
    """Sweep of the mean of the colours, its depth map, and the picture sharp everywhere.

    All colours have one depth map.

    - `distances`: mm, increasing.
    """
    images = jnp.asarray(images)
    focus = jnp.asarray(increasing(distances), images.dtype)
    sweep = RefocusSweep(jnp.mean(images, axis=1), focus, None)
    depth = depth_map(sweep)
    colours = [RefocusSweep(images[:, n], focus, None) for n in range(images.shape[1])]
    return sweep, depth, jnp.stack([all_in_focus(colour, depth) for colour in colours])


def _taken(stack, index):
    """Entry `index` (…) of a stack (n, …) at each pixel."""
    return jnp.take_along_axis(stack, index[None], axis=0)[0]
