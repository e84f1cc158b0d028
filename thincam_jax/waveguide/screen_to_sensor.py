r"""The screen-to-sensor camera: a mask and a bare sensor behind the screen, without a lens.

Thesis section 5.4 proposes it without equations. A mask at the distance d before the sensor takes
the place of the lens, so that a `SeeThroughCamera` with `focal_distance` d describes it: its
"pinhole" is the middle of the mask. Layers are parallel and holograms shift-invariant, hence light
of direction cosines **t** that crosses the mask at **m** comes, by order i, from the object at

.. math:: \mathbf P = \mathbf m + \pmb\Delta_i(\mathbf u), \qquad
    \mathbf u = -d\,\mathbf t/\sqrt{1-t^2}

with Δ_i the object point of `trace` for the pixel **u**, and meets the sensor at **m** + **u**. So

.. math:: g(\mathbf x) = \int |t(\mathbf m)|^2 \sum_i W_i(\mathbf u)\,
    f(\mathbf m + \pmb\Delta_i(\mathbf u))\, d\mathbf m

in ray optics, with **u** = **x** − **m**. An object point is imaged by each order, through the
middle of the mask, at the **u**_i with Δ_i(**u**_i) = **P**. About it Δ_i is linear, −T_i/d: the
light seems to come from a source T_i before the mask, and casts the shadow of the mask magnified by
1 + d/T_i. With the diffraction at the mask, the point spread function is

.. math:: h(\mathbf x; \mathbf P) = \sum_i W_i(\mathbf u_i)\,
    \frac{\det\pmb\Delta_0'}{\det(\pmb\Delta_i' - 1)}\,
    h_\mathrm{mask}(\mathbf x - \mathbf u_i;\ \lambda_C(\mathbf u_i), T_i)

Orders add up as irradiances: their paths differ by millimetres, and the band of the film leaves a
coherence length of some 60 µm. The ratio of determinants is the area of the object behind a part of
the mask over that of the first image. Left out are the smear of the colours in the band, (2i + 1)·4
µm on the sensor at the defaults and 550 mm, and that T_i differs along x and y.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax.waveguide.camera import SeeThroughCamera
from thincam_jax.waveguide.rays import RayStatus, bragg_rays, object_points, trace

MaskPsf = Callable[[Array, Array, Array], Array]
# Newton steps to an image: Δ is nearly linear, and so many leave rounding.
_STEPS = 5


class GhostImages(eqx.Module):
    """The images of object points by each order, through the middle of the mask.

    - `places`: (y, x) on the sensor, mm, (order, *point, 2).
    - `wavelength`: λ_C, mm, (order, *point).
    - `distance`: T of the virtual source from the mask, mm, the mean of x and y, (order, *point).
    - `weight`: W_i times the ratio of determinants, mm of bandwidth, (order, *point); 0 where a ray
      has another status than OK.
    """

    places: Float[Array, "order *point 2"]
    wavelength: Float[Array, "order *point"]
    distance: Float[Array, "order *point"]
    weight: Float[Array, "order *point"]


@checked
def ghost_images(
    camera: SeeThroughCamera,
    field: Float[Array, "*point 2"],
    object_distance: Number,
    orders: int = 4,
) -> GhostImages:
    """Images of an object's points by each order.

    **Arguments**

    - `camera`: with the mask's middle in place of the lens: `focal_distance` is d, and
      `lens_distance` the gap between mask and plate.
    - `field`: the points, given by their first images, (y, x) on the sensor, mm.
    - `object_distance`: from the plate's front surface, mm.
    """
    checks.at_least_one({"orders": orders})
    distance = checks.positive("object_distance", object_distance, "mm")
    return _ghost_images(camera, checks.points("field", field), distance, orders)


@eqx.filter_jit
def _ghost_images(
    camera: SeeThroughCamera,
    field: Float[Array, "*point 2"],
    distance: Float[Array, ""],
    orders: int,
) -> GhostImages:
    def point_of(order, place):
        rays = bragg_rays(camera, place)
        return object_points(camera, rays, distance, orders).ended[order]

    slope = jax.jacfwd(point_of, argnums=1)

    def image(order, first, target):
        def step(_, place):
            off = point_of(order, place) - target
            return place - jnp.linalg.solve(slope(order, place), off)

        place = jax.lax.fori_loop(0, _STEPS, step, first)
        return place, slope(order, place)

    def one(first):
        target, area = point_of(0, first), jnp.linalg.det(slope(0, first))
        return *jax.vmap(image, (0, None, None))(own, first, target), area

    own = jnp.arange(orders)
    places, slopes, area = jax.vmap(one, out_axes=(1, 1, 0))(field.reshape(-1, 2))
    depth = -camera.focal_distance * jnp.trace(slopes, axis1=-2, axis2=-1) / 2
    area = area / jnp.linalg.det(slopes - jnp.eye(2, dtype=slopes.dtype))
    rays = trace(camera, places, object_distance=distance, orders=orders)
    weight = jnp.where(rays.status[own, own] == RayStatus.OK, rays.weight[own, own], 0) * area
    shape = (orders, *field.shape[:-1])
    return GhostImages(
        places.reshape(*shape, 2),
        rays.wavelength.reshape(shape),
        depth.reshape(shape),
        weight.reshape(shape),
    )


@eqx.filter_jit
def ghost_psfs(images: GhostImages, mask_psf: MaskPsf) -> Float[Array, "*point k l"]:
    """Point spread functions of object points, each about its first image.

    `mask_psf` gives what the mask casts on the sensor, (k, l), for a wavelength and a source
    distance, mm, with its middle at a place (y, x), mm: `thincam_jax.psf` of a mask with that
    `centre`. It is traced. The sum of the weights of a point's orders is that of the images; divide
    by `images.weight.sum(axis=0)` of the axis for PSFs relative to an open screen.
    """
    orders, *shape = images.weight.shape
    shifts = (images.places - images.places[:1]).reshape(orders, -1, 2)
    parts = images.wavelength, images.distance, images.weight
    flat = [part.reshape(orders, -1) for part in parts]

    def one(order_parts):
        def add(total, parts):
            wavelength, distance, weight, shift = parts
            return total + weight * mask_psf(wavelength, distance, shift), None

        first = jax.tree.map(lambda part: part[0], order_parts)
        start = jnp.zeros_like(mask_psf(first[0], first[1], first[3]))
        return jax.lax.scan(add, start, order_parts)[0]

    moved = tuple(jnp.moveaxis(part, 0, 1) for part in (*flat, shifts))
    psfs = jax.lax.map(one, moved)
    return psfs.reshape(*shape, *psfs.shape[1:])
