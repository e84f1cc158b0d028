"""What a reconstruction returns."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.drive import Progress


class Reconstruction(eqx.Module):
    """A reconstructed image; with cameras upright as the scene is, with PSFs as the captures are.

    - `image`: radiance, (*batch, y, x), in the scene's unit; (*batch, plane, y, x) with planes.
    - `pitch`: distance of its pixels on the object, mm (of each plane); None if only PSFs are
      known.
    - `method`, `reason`: how it was made, and why so if that was left to "auto".
    - `ending`: how an iteration ended: "converged", "iterations_exhausted", "stopped" by the
      callback, "interrupted" by Ctrl-C or "non_finite"; None for methods in closed form.
    - `history`: objective and residuals along the way; see `Progress`.
    - `iterations`, `seconds`: done and taken; compilation is part of the time.
    - `tau`: the relative τ used, as given or found; None for methods without.
    """

    image: Float[Array, "*batch y x"]
    pitch: Float[Array, "*plane"] | None
    method: str = eqx.field(static=True, default="")
    reason: str = eqx.field(static=True, default="")
    ending: str | None = eqx.field(static=True, default=None)
    history: tuple[Progress, ...] = eqx.field(static=True, default=())
    iterations: int = eqx.field(static=True, default=0)
    seconds: float = eqx.field(static=True, default=0.0)
    tau: float | None = eqx.field(static=True, default=None)

    @property
    def status(self) -> str:
        """`ending`, or "ok" without one; "non_finite" for NaN or infinity. Unknown inside jit."""
        if not bool(jnp.isfinite(self.image).all()):
            return "non_finite"
        return self.ending or "ok"
