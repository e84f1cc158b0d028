"""The see-through-screen camera as a linear operator (thesis Eq 5.10)."""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators import Sparse
from thincam_jax.waveguide.camera import ObjectPlane, SeeThroughCamera, seen_size
from thincam_jax.waveguide.lens import LensView, lens_views
from thincam_jax.waveguide.rays import check_screen, pixel_centres, trace
from thincam_jax.waveguide.smear import SmearedRays, direct_rays, trace_band


class LitPlane(eqx.Module):
    """A flat object and the radiances of its cells, for a `ColourCamera` (channel, y, x)."""

    plane: ObjectPlane
    image: Float[Array, "*channel y x"]

    def __init__(self, plane: ObjectPlane, image: Numbers):
        self.plane = plane
        shape = *np.shape(image)[-3:-2], *plane.shape
        self.image = checks.finite("image", image, "radiance", shape=shape)
        if not checks.is_traced(self.image) and not np.asarray(self.image).any():
            raise ValueError("image is dark, and errors are relative to its capture; give light")


@dataclass(frozen=True, eq=False)
class Footprints:
    """The cells that pixels see along y and x, and what part of a pixel's light is from each.

    - `first`: index of the first cell, (y or x, *ray). It may lie outside of the object.
    - `parts`: parts of a pixel's light from that cell and its followers, (y or x, *ray, cell).
    """

    first: Int[np.ndarray, "2 *ray"]
    parts: Float[np.ndarray, "2 *ray cell"]


def footprints(points: Float[np.ndarray, "*ray 2"], plane: ObjectPlane, size: float) -> Footprints:
    """Overlaps of the cells with squares of the given size, mm, about points (y, x)."""
    pitch = float(plane.pitch)
    ratio = size / pitch
    if not 0 < ratio < 64:
        raise ValueError(
            f"a pixel sees {ratio:g} cells of the object; give cells of at least a 64th of the "
            f"{size:.3g} mm that it sees"
        )
    count = math.ceil(ratio) + 1
    numbers = np.asarray(plane.shape).reshape(2, *(1,) * (points.ndim - 1))
    middle = np.clip(in_cells(points, plane), -2 * count, numbers + 2 * count)
    low = middle[..., None] - ratio / 2
    edges = np.floor(low) + np.arange(count)
    parts = np.minimum(low + ratio, edges + 1) - np.maximum(low, edges)
    return Footprints(edges[..., 0].astype(np.int32), np.maximum(parts, 0) / ratio)


def entries_of_a_ray(camera: SeeThroughCamera, plane: ObjectPlane) -> int:
    """Entries of the system matrix that a ray makes at most: the cells that it may touch."""
    ratio = float(seen_size(camera, plane)) / float(plane.pitch)
    return (math.ceil(ratio) + 1) ** 2


def in_cells(
    points: Float[np.ndarray, "*ray 2"], plane: ObjectPlane
) -> Float[np.ndarray, "2 *ray"]:
    """Points (y, x), mm, as rows and columns of cells from the object's corner, in float64."""
    numbers, centre = np.asarray(plane.shape, float), np.asarray(plane.centre, float)
    places = (points.astype(float) - centre) / float(plane.pitch) + numbers / 2
    return np.moveaxis(places, -1, 0)


def smeared_rays(
    camera: SeeThroughCamera,
    pixels: Float[Array, "*pixel 2"],
    plane: ObjectPlane,
    orders: int,
    samples: int | None,
) -> SmearedRays:
    """`trace_band`, or for None `trace` as one sample at the Bragg wavelength."""
    if samples is not None:
        return trace_band(camera, pixels, plane.distance, orders, samples)
    rays = trace(camera, pixels, object_distance=plane.distance, orders=orders)
    return SmearedRays(rays.points[..., None, 1::-1], rays.weight)


@watched("tracing the screen")
def system_operator(
    camera: SeeThroughCamera | Sequence[SeeThroughCamera],
    plane: ObjectPlane | Sequence[ObjectPlane],
    *,
    orders: int = 4,
    samples: int | None = None,
) -> Sparse:
    r"""The capture of a lit object as the sum of its ghosts.

    .. math:: g(\mathbf x_0) = \sum_i W_i(\mathbf x_0)\, f(\mathbf P_i(\mathbf x_0)) \big/
        \overline{\textstyle\sum_i W_i}

    for white light, with the rays and weights of `trace`. A pixel sees a square of the object, its
    image by the lens; the cells' radiances are averaged over it exactly. Every pixel has its own
    shifts and weights: no convolution. The mean weight of a pixel's orders is 1, those that miss
    the object included, so that a uniform object that fills the field gives captures about its
    radiance.

    **Arguments**

    - `camera`: or a list of one for each colour of a full-colour hologram, which differ in their
      hologram alone. The sensor separates the colours; images are then (channel, plane, y, x)
      and captures (channel, y, x), and the level is that of each channel.
    - `plane`: or a list of planes of as many cells, whose light adds up: a near one hides nothing.
      Images are then (plane, y, x).
    - `orders`: number of ghosts; those that leave the hologram or miss the object do not count.
    - `samples`: parts of the band of each pixel and order, as `trace_band` divides it; None for
      the Bragg wavelength alone, without the smear of the band.

    Light straight through the plate is added where the camera has a `direct_band`.

    Of a lens with an aperture a pixel sees the mean of `lens_views`, with the defocus of every
    order. Vignetting by the lens and the pixel's own response are left out.

    **Errors**: ValueError where no pixel has a guided ray, for planes of different cells and
    sensors of different pixels, for cells below a 64th of a pixel's field, and a blur of 32 pixels.
    """
    if isinstance(camera, list | tuple):
        return colour_operator(
            [system_operator(c, plane, orders=orders, samples=samples) for c in camera]
        )
    if not isinstance(camera, SeeThroughCamera):
        raise TypeError(f"camera is {checks.shown(camera)}; give a waveguide.SeeThroughCamera")
    return planes_operator(camera, plane, (orders, samples))


def planes_operator(
    camera: SeeThroughCamera,
    plane: ObjectPlane | Sequence[ObjectPlane],
    counts: tuple[int, int | None],
    level: float | None = None,
) -> Sparse:
    """`system_operator` of one colour; `level`: weight, mm, that counts as 1."""
    planes = (plane,) if isinstance(plane, ObjectPlane) else plane
    if not isinstance(planes, Sequence) or not all(isinstance(p, ObjectPlane) for p in planes):
        raise TypeError(f"plane is {checks.shown(plane)}; give a waveguide.ObjectPlane, or several")
    shape = require_same("planes", "cells", [one.shape for one in planes])
    views = lens_views(camera, planes, counts[0])
    if level is None:
        level = bandwidth(smeared_rays(camera, pixel_centres(camera), planes[0], *counts))
    if level == 0:
        raise ValueError(
            "no light reaches the sensor by this screen; waveguide.check_screen says why"
        )

    def rays_to(plane: ObjectPlane):
        return lambda one: smeared_rays(one, pixel_centres(one), plane, *counts)

    matrices = [lens_matrix(views, rays_to(one), one, level) for one in planes]
    whole = shape if isinstance(plane, ObjectPlane) else (len(planes), *shape)
    return Sparse(scipy.sparse.hstack(matrices), whole, camera.sensor.shape)


def colour_operator(channels: Sequence[Sparse]) -> Sparse:
    """Colours side by side, from images (channel, plane, y, x) to captures (channel, y, x)."""
    image = require_same("channels", "cells", [one.in_shape for one in channels])
    capture = require_same("channels", "pixels", [one.out_shape for one in channels])
    size = math.prod(capture), math.prod(image)
    blocks = []
    for one in channels:
        values, rows, columns = (np.asarray(part) for part in (one.values, one.rows, one.columns))
        blocks.append(scipy.sparse.coo_array((values, (rows, columns)), shape=size))
    image = image if len(image) == 3 else (1, *image)
    count = len(channels)
    return Sparse(scipy.sparse.block_diag(blocks), (count, *image), (count, *capture))


def require_same(what: str, parts: str, shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape of all of them, of which there is one at least."""
    if len(set(shapes)) != 1:
        raise ValueError(f"{what} have {list(shapes)} {parts}; give at least one, all of one shape")
    return shapes[0]


def bandwidth(rays: SmearedRays) -> float:
    """Mean weight of the pixels' orders together, mm."""
    return float(jnp.mean(jnp.sum(rays.weight, axis=0)))


def lens_matrix(
    views: Sequence[LensView],
    rays_of: Callable[[SeeThroughCamera], SmearedRays],
    plane: ObjectPlane,
    level: float,
):
    """H of a lens, the mean of its views, with direct light; `level`: weight that is 1."""
    size, found = float(seen_size(views[0].camera, plane)), []
    for view in views:
        seen = [rays_of(view.camera)]
        if float(view.camera.direct_band) > 0:
            seen.append(direct_rays(view.camera, pixel_centres(view.camera), plane.distance))
        found += [system_matrix(rays, plane, size, level / view.share) for rays in seen]
    return functools.reduce(operator.add, found)


def system_matrix(rays: SmearedRays, plane: ObjectPlane, size: float, level: float):
    """H of pixels that see squares of the object of that size, mm; `level`: weight that is 1."""
    weight, points = np.asarray(rays.weight), np.asarray(rays.points)
    orders, *pixels, samples, _ = points.shape
    pixels = math.prod(pixels)
    points = points.reshape(orders, pixels, samples, 2)
    weight = weight.reshape(orders, pixels, -1) / weight.dtype.type(level * samples)
    rows, columns = plane.shape
    total = scipy.sparse.csr_array((pixels, rows * columns), dtype=weight.dtype)
    # Order by order, for the memory; entries at the same place are added up.
    for number in range(orders):
        seen = footprints(points[number], plane, size)
        parts = seen.parts.astype(weight.dtype)
        down, across = seen.first[..., None] + np.arange(parts.shape[-1], dtype=np.int32)
        values = weight[number][..., None, None] * parts[0][..., None] * parts[1][..., None, :]
        inside = ((down >= 0) & (down < rows))[..., None] & ((across >= 0) & (across < columns))[
            ..., None, :
        ]
        kept = inside & (values > 0)
        cells = (down[..., None] * columns + across[..., None, :])[kept]
        places = (np.nonzero(kept)[0], cells)
        total = total + scipy.sparse.csr_array((values[kept], places), shape=total.shape)
    return total


@watched("tracing the screen")
def monitor_system(
    camera: SeeThroughCamera, plane: ObjectPlane, orders: int = 4, band_samples: int | None = None
) -> tuple[Sparse, float]:
    """The matrix from a monitor's cells to the sensor: 1 where a white monitor is brightest.

    And the weight there, mm.

    **Errors**: ValueError for a screen that guides no light, or none of the monitor's.
    """
    check_screen(camera)
    system = planes_operator(camera, plane, (orders, band_samples), 1.0)
    brightest = float(jnp.max(system(jnp.ones(plane.shape, system.values.dtype))))
    if not brightest > 0:
        raise ValueError("no light from the monitor reaches the sensor")
    return eqx.tree_at(lambda s: s.values, system, system.values / brightest), brightest
