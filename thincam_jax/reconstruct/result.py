"""What a reconstruction returns."""

from typing import Literal

import equinox as eqx
from jaxtyping import Array, Float


class Reconstruction(eqx.Module):
    """A reconstructed image, upright as the scene is.

    - `image`: radiance, (*batch, y, x), in the scene's unit.
    - `pitch`: distance of its pixels on the object, mm.
    - `status`: "ok", or "non_finite" where the image holds NaN or infinity.
    """

    image: Float[Array, "*batch y x"]
    pitch: Float[Array, ""]
    status: Literal["ok", "non_finite"] = eqx.field(static=True, default="ok")
