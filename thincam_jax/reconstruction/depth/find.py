"""Distances from a sweep of the focus: of objects, and of every pixel with a sharp picture.

All are made of local averages ⟨·⟩ of the picture's derivatives, taken after a slight smoothing that
keeps the noise of single pixels out. Images of one sweep share a grid of directions, so that their
derivatives are directly comparable.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
import skimage
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import flat_root, product
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, increasing

Measure = Literal["laplacian_variance", "gradient_energy", "gradient_sparsity"]
MEASURES: tuple[Measure, ...] = get_args(Measure)


@checked
def focus_measure(
    image: Float[Array, "*batch y x"] | Float[np.ndarray, "*batch y x"],
    measure: Measure = "laplacian_variance",
    *,
    smoothing: float | int = 1.0,
    window: float | int | None = None,
    region: Bool[Array, "y x"] | Bool[np.ndarray, "y x"] | None = None,
) -> Float[Array, "..."]:
    r"""Sharpness of an image; the larger, the sharper.

    - "laplacian_variance": :math:`\langle (\Delta f)^2\rangle - \langle \Delta f\rangle^2`, the
      power of the finest detail, which has the most parallax: the narrowest curve.
    - "gradient_energy": :math:`\langle |\nabla f|^2\rangle` by Sobel differences (Tenengrad).
      Coarse detail weighs more; with a smoothing above a pixel it draws the maximum to larger t.
    - "gradient_sparsity": :math:`\langle |\nabla f|^2\rangle^{1/2} / \langle |\nabla f|\rangle`, at
      least 1: few steep edges in place of many shallow ones. Free of the picture's scale, so that
      regions of different brightness compare. For pictures with edges; blurred noise is as sparse.

    **Arguments**

    - `image`: (*batch, y, x), each measured separately.
    - `smoothing`: standard deviation of the Gaussian taken first, pixels; 0 for none.
    - `window`: standard deviation in pixels of the Gaussian average around each pixel; gives a map
      (*batch, y, x). Without, the average is over the image or over `region`: (*batch).
    - `region`: mask (y, x), true where to measure.

    **Errors**: ValueError for an unknown measure, a negative width, an empty region or both a
    window and a region.
    """
    checks.choice("measure", measure, MEASURES)
    image = checks.as_array(image, floating=True)
    average = _average(image.shape[-2:], image.dtype, window, region)
    smooth = gaussian_average(image, smoothing) if _width("smoothing", smoothing) else image
    if measure == "laplacian_variance":
        laplacian = _laplacian(smooth)
        return average(laplacian**2) - average(laplacian) ** 2
    squared = _squared_gradient(smooth)
    if measure == "gradient_energy":
        return average(squared)
    energy, length = average(squared), average(flat_root(squared))
    flat = length == 0
    return jnp.where(flat, 1, flat_root(energy) / jnp.where(flat, 1, length))


def gaussian_average(
    image: Float[Array, "*batch y x"], width: float | int
) -> Float[Array, "*batch y x"]:
    """Gaussian average around each pixel; at the border over the pixels there are.

    A `width` of 0 leaves the image unchanged.
    """
    if not _width("width", width):
        return image
    down, across = (jnp.asarray(_weights(n, width), image.dtype) for n in image.shape[-2:])
    return product(product(down, image), across.T)


def _weights(count: int, width: float | int) -> np.ndarray:
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    weights = np.exp(-0.5 * (distance / width) ** 2)
    return weights / weights.sum(axis=1, keepdims=True)


def _average(shape, dtype, window, region) -> Callable[[Array], Array]:
    """The average ⟨·⟩: over a window, a region or the whole image."""
    if window is not None:
        if region is not None:
            raise ValueError("give a window (for a map) or a region (for a number), not both")
        if not _width("window", window):
            raise ValueError("window = 0 holds no pixels; give a width of at least 0.5 pixels")
        return lambda values: gaussian_average(values, window)
    if region is None:
        return lambda values: jnp.mean(values, axis=(-2, -1))
    if region.shape != shape:
        raise ValueError(f"region has shape {region.shape}; give a mask of {shape} pixels")
    if not checks.is_traced(region) and not np.asarray(region).any():
        raise ValueError("region holds no pixel; mark with true where to measure")
    inside = jnp.asarray(region).astype(dtype)
    return lambda values: jnp.sum(values * inside, axis=(-2, -1)) / jnp.sum(inside)


def _width(name: str, value: float | int) -> float:
    if not 0 <= value < np.inf:
        raise ValueError(f"{name} = {value} pixels; give a width of at least 0")
    return float(value)


def _padded(image):
    """One pixel more on every side, a copy of its neighbour: no edge at the image's border."""
    return jnp.pad(image, [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)], mode="edge")


@jax.jit
def _laplacian(image):
    f = _padded(image)
    rows = f[..., :-2, 1:-1] + f[..., 2:, 1:-1]
    columns = f[..., 1:-1, :-2] + f[..., 1:-1, 2:]
    return rows + columns - 4 * image


@jax.jit
def _squared_gradient(image):
    """|∇f|² by Sobel's differences, per pixel."""
    f = _padded(image)
    across = (f[..., 2:] - f[..., :-2]) / 2
    down = (f[..., 2:, :] - f[..., :-2, :]) / 2
    across = (across[..., :-2, :] + 2 * across[..., 1:-1, :] + across[..., 2:, :]) / 4
    down = (down[..., :-2] + 2 * down[..., 1:-1] + down[..., 2:]) / 4
    return across**2 + down**2


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
