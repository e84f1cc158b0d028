"""What a reconstruction returns."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Reconstruction(eqx.Module):
    """A reconstructed image, upright as the scene is.

    - `image`: radiance, (*batch, y, x), in the scene's unit.
    - `pitch`: distance of its pixels on the object, mm.
    - `status`: "ok", or "non_finite" where the image holds NaN or infinity; not known inside jit.
    """

    image: Float[Array, "*batch y x"]
    pitch: Float[Array, ""]

    @property
    def status(self) -> Literal["ok", "non_finite"]:
        return "ok" if bool(jnp.isfinite(self.image).all()) else "non_finite"
