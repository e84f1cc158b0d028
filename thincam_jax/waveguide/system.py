"""The see-through-screen camera as a linear operator (thesis Eq 5.10)."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import sparse
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers, Shape
from thincam_jax.imaging.operators import Sparse
from thincam_jax.waveguide.camera import SeeThroughCamera
from thincam_jax.waveguide.rays import pixel_centres, trace


class ObjectPlane(eqx.Module):
    """A flat object before the screen, of square cells of uniform radiance, as those of a monitor.

    - `shape`: (rows, columns) of cells.
    - `distance`: d2, from the plate's front surface, mm.
    - `width`: of the object, mm.
    - `centre`: (x, y) of its middle from the camera's axis, mm; +y is down.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    distance: Float[Array, ""]
    width: Float[Array, ""]
    centre: Float[Array, "2"]

    def __init__(self, shape: Shape, distance: Number, width: Number, centre: Numbers):
        self.shape = checks.shape2d("shape", shape)
        self.distance = checks.positive("distance", distance, "mm")
        self.width = checks.positive("width", width, "mm")
        self.centre = checks.finite("centre", centre, "mm", shape=(2,))

    @property
    def pitch(self) -> Float[Array, ""]:
        """Of the cells, mm."""
        return self.width / self.shape[1]


class _Footprint(NamedTuple):
    """The cells that pixels see along one axis, and what part of a pixel's light is from each."""

    cells: Array
    parts: Array


def system_operator(camera: SeeThroughCamera, plane: ObjectPlane, orders: int = 4) -> Sparse:
    r"""The capture of a lit object as the sum of its ghosts.

    .. math:: g(\mathbf x_0) = \sum_i W_i(\mathbf x_0)\, f(\mathbf P_i(\mathbf x_0)) \big/
        \overline{\textstyle\sum_i W_i}

    for white light, with the rays and weights of `trace`. A pixel sees a square of the object, its
    image by the lens; the cells' radiances are averaged over it exactly. Every pixel has its own
    shifts and weights: no convolution. The mean weight of a pixel's orders is 1, those that miss
    the object included, so that a uniform object that fills the field gives captures about its
    radiance.

    **Arguments**

    - `orders`: how many ghosts; those that leave the hologram or miss the object do not count.

    Vignetting by the lens and the pixel's own response are left out, and so is the smear of the
    colours beside each pixel's Bragg wavelength.
    """
    rays = trace(camera, pixel_centres(camera), plane.distance, orders)
    distance = camera.lens_distance + plane.distance
    size = camera.sensor.pitch * distance / camera.focal_distance
    cell = plane.pitch
    ratio = float(size / cell)
    if not 0 < ratio < 64:
        raise ValueError(
            f"a pixel sees {ratio:g} cells of the object; give cells of at least a 64th of the "
            f"{float(size):.3g} mm that it sees"
        )
    count = math.ceil(ratio) + 1
    rows, columns = plane.shape
    down, across = (_footprint(rays.points[..., axis], plane, axis, size, count) for axis in (1, 0))
    weight = rays.weight / jnp.mean(jnp.sum(rays.weight, axis=0))
    # (order, y, x, cell of the footprint)
    inside = ((down.cells >= 0) & (down.cells < rows))[..., :, None] & (
        (across.cells >= 0) & (across.cells < columns)
    )[..., None, :]
    values = weight[..., None, None] * down.parts[..., :, None] * across.parts[..., None, :]
    cells = down.cells[..., :, None] * columns + across.cells[..., None, :]
    pixels = np.arange(math.prod(camera.sensor.shape)).reshape(*camera.sensor.shape, 1, 1)
    kept = np.asarray(inside & (values > 0)).reshape(-1)
    entries = np.broadcast_to(pixels, cells.shape).reshape(-1)[kept]
    places = jnp.stack([jnp.asarray(entries), cells.reshape(-1)[kept]], axis=-1)
    shape = (math.prod(camera.sensor.shape), rows * columns)
    matrix = sparse.BCOO((values.reshape(-1)[kept], places.astype(jnp.int32)), shape=shape)
    return Sparse(matrix, plane.shape, camera.sensor.shape)


def _footprint(points, plane: ObjectPlane, axis: int, size, count: int) -> _Footprint:
    """Overlap of an interval of that size about each point with the cells along an axis."""
    number = plane.shape[1 - axis]
    start = plane.centre[axis] - number * plane.pitch / 2
    low = (points - size / 2 - start) / plane.pitch
    high = low + size / plane.pitch
    first = jax.lax.stop_gradient(jnp.floor(low))
    edges = first[..., None] + jnp.arange(count, dtype=low.dtype)
    parts = jnp.minimum(high[..., None], edges + 1) - jnp.maximum(low[..., None], edges)
    return _Footprint(edges.astype(int), jnp.maximum(parts, 0) * plane.pitch / size)
