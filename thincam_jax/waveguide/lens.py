r"""A lens of finite aperture as pinholes side by side.

A thin lens at d₀ before the sensor, in focus at s, takes the light of a pixel **u** from the point
−s**u**/d₀ of its plane of focus. What crosses the lens at **a** has the slope

.. math:: -\frac{\mathbf u}{d_0} - \frac{\mathbf a}{s}

so that a lens is the mean of pinholes at **a**, of which each sees the object from elsewhere, in
another direction. In air, an object at s′ is blurred over A|1 − s′/s| by an aperture A. A ghost's
way through the glass changes with the direction, more along the screen than across: it is sharp at
other distances than the image, one for each direction.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax.waveguide.camera import ObjectPlane, SeeThroughCamera, seen_size
from thincam_jax.waveguide.rays import RayStatus, trace

# Blurs, in fields of a pixel, that change nothing. One ring per such field of the blur's radius
# leaves 0.4 % of the capture of cells of random light.
_SHARP = 0.02
_MOST = 16  # rings: 817 points
_PIXELS = 9  # along each side of the sensor, at which the blur is looked at


@dataclass(frozen=True, eq=False)
class LensView:
    """A pinhole's camera, and its share of the light of the lens."""

    share: float
    camera: SeeThroughCamera


def lens_views(
    camera: SeeThroughCamera, planes: Sequence[ObjectPlane], orders: int
) -> tuple[LensView, ...]:
    """Pinholes whose mean is the camera's lens, as dense as the blur of the objects demands.

    They lie on rings about the middle. Of a pinhole, or where nothing is blurred, there is one.

    **Errors**: ValueError for a blur of more than 32 pixels.
    """
    rings = 0
    if float(camera.aperture) > 0:
        blur = max(blur_radius(camera, plane, orders) for plane in planes)
        rings = math.ceil(blur) if blur > _SHARP else 0
        if rings > _MOST:
            raise ValueError(
                f"objects are blurred over {2 * blur:.0f} pixels; give the lens a smaller aperture "
                f"than {float(camera.aperture):g} mm, or a focus_distance nearer to the object's"
            )
    points, shares = aperture_points(rings)
    places = jnp.asarray(points, camera.lens_point.dtype) * camera.aperture / 2
    views = [eqx.tree_at(lambda c: c.lens_point, camera, place) for place in places]
    return tuple(map(LensView, shares.tolist(), views))


def aperture_points(rings: int) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, " point"]]:
    """Points (y, x) in a circle of radius 1, and their shares of its area.

    Ring k has 6k points, at the radius √((k² + ¼)/(r + ½)²) of its part of the area.
    """
    points, areas = [np.zeros((1, 2))], [np.full(1, 0.25)]
    for ring in range(1, rings + 1):
        angles = 2 * np.pi * (np.arange(6 * ring) + 0.5 * (ring % 2)) / (6 * ring)
        radius = np.hypot(ring, 0.5) / (rings + 0.5)
        points.append(radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1))
        areas.append(np.full(6 * ring, 1 / 3))
    shares = np.concatenate(areas)
    return np.concatenate(points), shares / shares.sum()


def blur_radius(camera: SeeThroughCamera, plane: ObjectPlane, orders: int) -> float:
    """Largest distance on the object between what a pixel sees by the lens' middle and its edge.

    In fields of a pixel, over the rays of some pixels and all orders that meet the object.
    """
    sides = np.array(camera.sensor.shape) * float(camera.sensor.pitch) / 2
    places = np.stack(np.meshgrid(*(np.linspace(-s, s, _PIXELS) for s in sides)), axis=-1)
    dtype = camera.lens_point.dtype
    pixels, extent = jnp.asarray(places.reshape(-1, 2), dtype), plane.extent

    def seen(*place: int):
        point = jnp.asarray(place, dtype) * camera.aperture / 2
        one = eqx.tree_at(lambda c: c.lens_point, camera, point)
        how: Any = {"object_distance": plane.distance, "orders": orders, "extent": extent}
        return trace(one, pixels, **how)

    middle = seen(0, 0)
    edges = np.stack([seen(*place).points for place in ((0, 1), (0, -1), (1, 0), (-1, 0))])
    away = np.linalg.norm((edges - middle.points)[..., :2], axis=-1)
    met = np.asarray(middle.status) == RayStatus.OK
    return float(np.max(away * met)) / float(seen_size(camera, plane))
