"""The field of view of a see-through-screen camera, from its rays."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax.units import deg
from thincam_jax.waveguide.camera import SeeThroughCamera
from thincam_jax.waveguide.rays import RayStatus, bragg_rays, object_points, ray_status

# Rays along each axis of the sensor: of 60 degrees a step is 0.004.
_RAYS = 16001


@dataclass(frozen=True)
class FieldOfView:
    """Angles between the extreme rays in the planes through the camera's axis, degrees.

    0 where no ray of that plane reaches the sensor.
    """

    vertical_deg: float
    horizontal_deg: float

    def __str__(self) -> str:
        """Vertical by horizontal."""
        return f"{self.vertical_deg:.1f}° × {self.horizontal_deg:.1f}°"


@checked
def field_of_view(camera: SeeThroughCamera, *, orders: int = 1) -> FieldOfView:
    """Field of view: directions whose light reaches the sensor, of objects of any size.

    It ends at the sensor's edges, the critical angle, grazing light in the glass or the holograms'
    edges, whichever comes first. A plate of parallel surfaces keeps directions, so that a ray from
    the sensor's point (y, x) has the slopes −(y, x)/d0; whether light takes it is its `RayStatus`.

    **Arguments**

    - `orders`: 1 for the image itself; more include directions that only its ghosts show, up to
      i = orders − 1.

    **Returns**: `FieldOfView`, to 0.01° for fields up to 60°. The vertical one is along y, down the
    plate.

    **Errors**: ValueError for `orders` below 1.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um
    from thincam_jax.waveguide.design.plate import Plate
    from thincam_jax.waveguide.field_of_view import field_of_view

    camera = Plate().camera(tc.Sensor((440, 440), 4.8 * um))
    print(field_of_view(camera))  # 20.0° × 20.0°
    ```

    See also: `design.plate.judge_plate`, whose closed form has gradients, without holograms' edges.
    """
    checks.at_least_one({"orders": orders})
    halves = np.array(camera.sensor.shape) * float(camera.sensor.pitch) / 2
    along = np.linspace(-1, 1, _RAYS)[:, None]
    lines = np.stack([along * halves * axis for axis in np.eye(2)])
    pixels = jnp.asarray(lines, camera.focal_distance.dtype)
    seen = np.asarray(_arrive(camera, pixels, orders))
    angles = np.arctan(lines.sum(axis=-1) / float(camera.focal_distance)) / deg
    fields = [np.ptp(line[on]) if on.any() else 0.0 for line, on in zip(angles, seen, strict=True)]
    return FieldOfView(*(round(float(field), 2) for field in fields))


@eqx.filter_jit
def _arrive(
    camera: SeeThroughCamera, pixels: Float[Array, "*pixel 2"], orders: int
) -> Bool[Array, "*pixel"]:
    """Whether light of some order reaches a point of the sensor, from an object of any size."""
    found = bragg_rays(camera, pixels)
    # The distance of the object changes nothing.
    path = object_points(camera, found, jnp.ones_like(camera.focal_distance), orders)
    return (ray_status(camera.screen, found.fault, path) == RayStatus.OK).any(axis=0)
