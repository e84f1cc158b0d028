"""Light over the field: how bright a point off the axis is on the sensor."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax.imaging.sensor import Sensor


def light_over_field(
    sensor: Sensor, down: Float[np.ndarray, " m"], across: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m n"] | Float[Array, "m n"]:
    r"""Relative light of the field's points at the tangents of two angles: 1 on the axis.

    cos⁴θ (`fall_of_light`) times the sensor's `angular_response`: its pixels see a point's light
    under the angle θ, whatever the mask did to it, as it turns light by λν ≪ 1 only. Micro-lenses
    whose chief ray changes over the sensor are not modelled: for those, take the mean response.
    """
    fall, given = fall_of_light(down, across), sensor.angular_response
    if given is None:
        return fall
    if given.ndim == 0:
        return fall * fall ** (given / 4)
    angles = np.arctan(np.hypot(down[:, None], across))
    return fall * jnp.interp(jnp.asarray(angles, given.dtype), given[:, 0], given[:, 1])


def fall_of_light(
    down: Float[np.ndarray, " m"], across: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m n"]:
    r"""cos⁴θ at the tangents of two angles: the light of a plane of equal radiance on the sensor.

    A patch dA of the plane sends :math:`L\,dA\cos\theta` per solid angle towards the mask, over
    the way :math:`t/\cos\theta` onto pixels tilted by θ: :math:`L\,dA\cos^4\theta/t^2`. The same
    holds for a scene at infinity, where the solid angle of a step of the tangents is
    :math:`\cos^3\theta`. A display or a lamp that is brighter along its normal falls faster;
    multiply the scene with the rest.
    """
    return (1 + down[:, None] ** 2 + across**2) ** -2


@checked
def shading(
    down: Numbers, across: Numbers, *, depth: Number, opening: Number, width: Number | None = None
) -> Float[np.ndarray, "m n"]:
    r"""Part of a square opening that is lit past an edge before it: of walls and of baffles.

    Light at the tangents :math:`u_i` shifts the edge's shadow by :math:`h u_i` over a depth h. Of
    an opening of width w behind one of width a it leaves, along each axis,

    .. math:: \frac1w \max\bigl(0,\ \min(\tfrac w2, \tfrac a2 + h u_i)
        - \max(-\tfrac w2, -\tfrac a2 + h u_i)\bigr).

    It is a factor of the scene, which is multiplied with it; PSFs keep their shape, of which a
    baffle that shades a part of the mask takes that part's light, too.

    - `down`, `across`: tangents of the angles of the scene's rows and columns, (y, x)/t.
    - `depth`: depth of the walls of a mask's openings (its thickness), or distance from a baffle to
      the mask, mm.
    - `opening`: width of the first edge, mm: of a mask's openings, or of the baffle.
    - `width`: width of the area behind, mm: the mask, for a baffle; by default that of the opening.

    ```python
    import numpy as np
    from thincam_jax.lensless.light import shading

    slopes = np.linspace(-90, 90, 5) / 250  # a scene 180 mm wide at 250 mm
    part = shading(slopes, slopes, depth=0.03, opening=0.06)  # openings of 60 µm in 30 µm
    print(part[2].round(2))  # [0.82 0.91 1.   0.91 0.82]
    ```

    **See also**: `ImagePlane`, `Sensor`.
    """
    depth = float(checks.non_negative("depth", depth, "mm"))
    opening = float(checks.positive("opening", opening, "mm"))
    behind = opening if width is None else float(checks.positive("width", width, "mm"))
    rows, columns = (
        _overlap(depth * checks.numbers(name, given), opening / 2, behind / 2)
        for name, given in (("down", down), ("across", across))
    )
    return rows[:, None] * columns


def _overlap(moved: Float[np.ndarray, " n"], edge: float, half: float) -> Float[np.ndarray, " n"]:
    lit = np.minimum(half, edge + moved) - np.maximum(-half, -edge + moved)
    return np.maximum(lit, 0.0) / (2 * half)
