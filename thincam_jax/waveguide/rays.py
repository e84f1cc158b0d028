r"""Rays from pixels back through lens and screen to the object (thesis Eq 5.1–5.3, 5.6–5.9).

Parallel layers keep the tangential direction cosines **t** of a ray, and each hologram mirrors it
at its fringes; so a ray is two vectors: **t** before and **p** = n·s′ between the holograms. The
object point of order i, of 2i total reflections, is then

.. math:: \mathbf P_i = (d_1 + d_2)\frac{\mathbf t}{\sqrt{1-t^2}}
    + (2i+1)\,w\frac{\mathbf p}{\sqrt{n_g^2-p^2}} + 2w\frac{\mathbf t}{\sqrt{n_g^2-t^2}}

without any angle, so that it has gradients on the axis too. Of a tilted plate **t** and **p** are
in its own axes, and what it moves a ray sideways is brought to the object along the ray.

Places on a plane are (y, x), as everywhere; vectors in space and direction cosines (x, y, z).
"""

import enum
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.precision import product
from thincam_jax.waveguide.camera import Rectangle, Screen, SeeThroughCamera
from thincam_jax.waveguide.efficiency import weights_about
from thincam_jax.waveguide.hologram import directions


class RayStatus(enum.IntEnum):
    """Status of a ray of one order."""

    OK = 0
    NO_BRAGG_MATCH = 1  # no wavelength in the film's band is diffracted back
    EVANESCENT = 2  # diffracted more obliquely than the glass can carry
    NOT_GUIDED = 3  # below the critical angle: it leaves the glass
    OFF_HOLOGRAM = 4  # it meets the screen where there is no hologram
    MISSED = 5  # it passes the object


class Rays(eqx.Module):
    """Rays of all pixels and orders.

    - `points`: (x, y, z) on the object's plane, mm, (order, *pixel, 3). Finite for every status.
    - `wavelength`: the Bragg wavelength, (*pixel), mm.
    - `weight`: ∫ η²(1−η)^m dλ with m earlier contacts with the hologram, (order, *pixel), mm; 0 for
      rays that are not OK.
    - `guided`: direction cosines (x, y) of the guided light times its index, (*pixel, 2).
    - `status`: end of each ray, a number of `RayStatus`, (order, *pixel).
    """

    points: Float[Array, "order *pixel 3"]
    wavelength: Float[Array, "*pixel"]
    weight: Float[Array, "order *pixel"]
    guided: Float[Array, "*pixel 2"]
    status: Int[Array, "order *pixel"]


@checked
def trace(
    camera: SeeThroughCamera,
    pixels: Numbers,
    *,
    object_distance: Number,
    orders: int = 4,
    extent: Rectangle | None = None,
) -> Rays:
    """Trace rays from points on the sensor to a plane before the screen.

    **Arguments**

    - `pixels`: (y, x) on the sensor, mm from its middle: (*pixel, 2).
    - `object_distance`: d2, from the plate's front surface, mm; of several planes by `jax.vmap`.
    - `orders`: number of ghosts, i = 0 … orders − 1, of 2i total reflections each.
    - `extent`: limits of the object, (y, x) mm from the camera's axis; None is infinite.

    Rays cross the lens at the camera's `lens_point`, by default its middle, and the holograms are
    thin against the glass. They are those of the Bragg wavelength of each pixel; the weights
    include the rest of the band, but not its smear.
    """
    checks.at_least_one({"orders": orders})
    distance = checks.positive("object_distance", object_distance, "mm")
    return _trace(camera, checks.points("pixels", pixels), distance, orders, extent)


@eqx.filter_jit
def _trace(
    camera: SeeThroughCamera,
    pixels: Float[Array, "*pixel 2"],
    distance: Float[Array, ""],
    orders: int,
    extent: Rectangle | None,
) -> Rays:
    screen = camera.screen
    found = bragg_rays(camera, pixels)
    wavelength, guided, fault = found.wavelength, found.guided, found.fault
    path = object_points(camera, found, distance, orders)
    status = ray_status(screen, fault, path, extent)
    weight = weights_about(screen.hologram, found.across, wavelength, orders)
    if screen.bottom is not None:
        # Only contacts with the hologram take a part of the light away.
        contacts = screen.bottom.holds(path.bottom).astype(int)
        weight = jnp.take_along_axis(weight, jnp.cumsum(contacts, axis=0) - contacts, axis=0)
    end = camera.focal_distance + camera.lens_distance + screen.glass_thickness + distance
    depth = jnp.broadcast_to(end, (*path.ended.shape[:-1], 1)).astype(path.ended.dtype)
    points = jnp.concatenate([path.ended[..., ::-1], depth], axis=-1)
    return Rays(points, wavelength, jnp.where(status == RayStatus.OK, weight, 0), guided, status)


class BraggRays(eqx.Module):
    """Rays of each pixel's Bragg wavelength up to where they are guided.

    - `slope`: x/z and y/z before and after the plate, against the camera, (*pixel, 2).
    - `across`: direction cosines (x, y) in air, against the plate, (*pixel, 2).
    - `wavelength`: mm, (*pixel).
    - `guided`: p, direction cosines of the guided light times its index, (*pixel, 2).
    - `left`: n_g² − p², of which the part along z is the root, (*pixel).
    - `fault`: the first `RayStatus` up to here, (*pixel).
    """

    slope: Float[Array, "*pixel 2"]
    across: Float[Array, "*pixel 2"]
    wavelength: Float[Array, "*pixel"]
    guided: Float[Array, "*pixel 2"]
    left: Float[Array, "*pixel"]
    fault: Int[Array, "*pixel"]


def bragg_rays(camera: SeeThroughCamera, pixels: Float[Array, "*pixel 2"]) -> BraggRays:
    """Rays from pixels, (y, x) mm, through lens and rear surface to the top hologram."""
    hologram = camera.screen.hologram
    axes, slope = camera.plate_axes, slopes(camera, pixels)
    across = product(slope, axes[:2, :2]) + axes[2, :2]
    across = across / jnp.sqrt(jnp.sum(slope**2, axis=-1, keepdims=True) + 1)
    wavelength, matched = hologram.bragg_wavelength(across)
    film = hologram.index(wavelength)
    inside = directions(across, film)
    mirrored = hologram.diffracted(inside)
    guided = film[..., None] * mirrored[..., :2]
    matched = matched & (jnp.sum(inside * hologram.grating, -1) > 0) & (mirrored[..., 2] < 0)
    glass = camera.screen.glass_index(wavelength)
    # n_g² − p² by the mirrored z, in which no digits cancel where p is large.
    left = (film * mirrored[..., 2]) ** 2 + (glass - film) * (glass + film)
    fault = jnp.full(wavelength.shape, int(RayStatus.OK))
    # The first fault of a ray, in the order in which it comes to it, is written last.
    for status, sound in (
        (RayStatus.NOT_GUIDED, jnp.sum(guided**2, axis=-1) > 1),
        (RayStatus.EVANESCENT, left > 0),
        (RayStatus.NO_BRAGG_MATCH, matched),
    ):
        fault = jnp.where(sound, fault, int(status))
    return BraggRays(slope, across, wavelength, guided, left, fault)


def slopes(camera: SeeThroughCamera, pixels: Float[Array, "*pixel 2"]) -> Float[Array, "*pixel 2"]:
    """x/z and y/z of rays through the lens' point to where a pixel (y, x) is sharp."""
    along, sharp = pixels / camera.focal_distance, camera.focus_distance
    return -(along if sharp is None else along + camera.lens_point / sharp)[..., ::-1]


class RayPath(eqx.Module):
    """Points (y, x), mm, of rays on the holograms and on the object's plane."""

    top: Float[Array, "*pixel 2"]
    bottom: Float[Array, "order *pixel 2"]
    ended: Float[Array, "order *pixel 2"]


def object_points(
    camera: SeeThroughCamera, rays: BraggRays, distance: Float[Array, ""], orders: int
) -> RayPath:
    """Paths from the lens to the object, for each order."""
    width = camera.screen.glass_thickness
    bounce = rays.guided / jnp.sqrt(jnp.where(rays.left > 0, rays.left, 1))[..., None]
    crossing = shift(rays.across, camera.screen.glass_index(rays.wavelength))
    top = at_rear(camera, rays.slope) + width * crossing
    odd = 2 * jnp.arange(orders, dtype=top.dtype) + 1
    guided = jnp.expand_dims(odd, range(1, top.ndim + 1)) * width * bounce
    moved = on_object(camera, rays.slope, guided + 2 * width * crossing)
    places = top, top + guided, straight_on(camera, rays.slope, distance) + moved
    return RayPath(*(place[..., ::-1] for place in places))


def ray_status(
    screen: Screen, fault: Int[Array, "*pixel"], path: RayPath, extent: Rectangle | None = None
) -> Int[Array, "order *pixel"]:
    """How rays of a fault up to the top hologram end, on an object of that extent."""
    on_top = True if screen.top is None else screen.top.holds(path.top)
    on_bottom = True if screen.bottom is None else screen.bottom.holds(path.bottom)
    met = True if extent is None else extent.holds(path.ended)
    status = jnp.where(met, int(RayStatus.OK), int(RayStatus.MISSED))
    status = jnp.where(on_bottom & on_top, status, int(RayStatus.OFF_HOLOGRAM))
    status = jnp.where(fault == RayStatus.OK, status, fault)
    return jnp.broadcast_to(status, path.bottom.shape[:-1])


def at_rear(camera: SeeThroughCamera, slope: Float[Array, "*ray 2"]) -> Float[Array, "*ray 2"]:
    """Points (x, y), mm, at which rays from the lens meet the plate's rear surface."""
    axes, start = camera.plate_axes, camera.lens_point[::-1]
    tangential = product(slope, axes[:2, :2]) + axes[2, :2]
    normal = product(slope, axes[:2, 2]) + axes[2, 2]
    height = camera.lens_distance * axes[2, 2] - product(start, axes[:2, 2])
    across = product(start, axes[:2, :2]) - camera.lens_distance * axes[2, :2]
    return height * tangential / normal[..., None] + across


def straight_on(
    camera: SeeThroughCamera, slope: Float[Array, "*ray 2"], distance: Float[Array, "..."]
) -> Float[Array, "*ray 2"]:
    """Points (x, y), mm, on the object that rays meet without displacement by the plate."""
    normal, width = camera.plate_axes[:, 2], camera.screen.glass_thickness
    further = width * (normal[:2] + (1 - normal[2]) * slope)
    return camera.lens_point[::-1] + (camera.lens_distance + distance) * slope + further


def on_object(
    camera: SeeThroughCamera, slope: Float[Array, "*#ray 2"], sideways: Float[Array, "*#ray 2"]
) -> Float[Array, "*ray 2"]:
    """Displacement on the object of a ray displaced along the plate by (x, y) mm."""
    axes = camera.plate_axes
    along = product(sideways, axes[2, :2])[..., None] * slope
    return product(sideways, axes[:2, :2].T) - along


def shift(tangential: Float[Array, "*#ray 2"], index: Float[Array, "*#ray"]):
    """Sideways distance of light in a layer of thickness 1: p/√(n² − p²)."""
    squared = jnp.sum(tangential**2, axis=-1)
    return tangential / jnp.sqrt(index**2 - squared)[..., None]


@checked
def pixel_centres(camera: SeeThroughCamera) -> Float[Array, "y x 2"]:
    """Centres (y, x) of the sensor's pixels, mm."""
    grid = camera.sensor.grid
    return jnp.stack(jnp.meshgrid(grid.y, grid.x, indexing="ij"), axis=-1)


@checked
def check_screen(camera: SeeThroughCamera) -> None:
    """ValueError, saying what to change, where the sensor's middle would see nothing.

    Light has to be diffracted beyond the critical angle of the glass, and no hologram may be
    shorter than the way 2wp/√(n_g² − p²) from one contact to the next, or light would pass it by.
    """
    screen = camera.screen
    middle = bragg_rays(camera, jnp.zeros_like(screen.hologram.grating[:2]))
    guided, fault = middle.guided, middle.fault
    index, across = float(screen.glass_index(middle.wavelength)), float(jnp.linalg.norm(guided))
    if fault == RayStatus.NO_BRAGG_MATCH:
        raise ValueError(
            "the hologram diffracts no wavelength of its index's band back to the sensor's middle; "
            "record it with other angles or another wavelength"
        )
    if fault == RayStatus.EVANESCENT:
        raise ValueError(
            f"light is diffracted to n sin Θ' = {across:.4g}, which a glass of n = {index:.4g} "
            "cannot carry; give a smaller reference angle or a glass of higher index"
        )
    if fault == RayStatus.NOT_GUIDED:
        angle, critical = (math.degrees(math.asin(sine / index)) for sine in (across, 1.0))
        raise ValueError(
            f"light is diffracted to Θ' = {angle:.2f}° in the glass, under the critical angle of "
            f"{critical:.2f}° (n = {index:.4g}), and leaves it; give a larger reference angle"
        )
    bounce = 2 * float(screen.glass_thickness) * guided[::-1] / float(middle.left) ** 0.5
    for name, hologram in (("top", screen.top), ("bottom", screen.bottom)):
        if hologram is not None and bool(jnp.any(hologram.size < jnp.abs(bounce))):
            size, step = (
                ", ".join(f"{float(n):.4g}" for n in v) for v in (hologram.size, abs(bounce))
            )
            raise ValueError(
                f"{name}.size = ({size}) mm is smaller than one bounce of the guided light, "
                f"({step}) mm: light would pass it by; give a larger hologram or a thinner glass"
            )
