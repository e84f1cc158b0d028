"""Reconstructed images."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.module import Module
from thincam_jax._core.quantity import unchecked
from thincam_jax.reconstruction.iterate import Progress


class Reconstruction(Module):
    """A reconstructed image; with cameras upright as the scene is, otherwise as the captures are.

    - `image`: radiance, (*batch, y, x), in the scene's unit; (*batch, plane, y, x) with planes.
    - `pitch`: distance of its pixels on the object, mm (of each plane); None without cameras.
    - `method`, `reason`: how it was made, and why so if that was left to `choose_solver`, or what
      was noticed when τ was left to a rule.
    - `ending`: how an iteration ended: "converged", "iterations_exhausted", "stopped" by the
      callback, "interrupted" by Ctrl-C or "non_finite"; None for methods in closed form.
    - `history`: objective and residuals along the way; see `Progress`.
    - `iterations`, `seconds`: done and taken; compilation is part of the time.
    - `tau`: the relative τ used, as given or found; None for methods without.
    - `consistency`, `confidence`: measures of trust in a learned method, which may make things up:
      residual of the explained capture, root mean square, over the noise's deviation, for each
      element of the batch; and how sure it is of each pixel, 0 to 1, (*batch, y, x).
    """

    image: Float[Array, "*batch y x"]
    pitch: Float[Array, "*plane"] | None = eqx.field(converter=unchecked("mm"))
    method: str = eqx.field(static=True, default="")
    reason: str = eqx.field(static=True, default="")
    ending: str | None = eqx.field(static=True, default=None)
    history: tuple[Progress, ...] = eqx.field(static=True, default=(), repr=False)
    iterations: int = eqx.field(static=True, default=0)
    seconds: float = eqx.field(static=True, default=0.0)
    tau: float | None = eqx.field(static=True, default=None)
    consistency: Float[Array, "*capture"] | None = None
    confidence: Float[Array, "*capture y x"] | None = None

    @property
    def status(self) -> str:
        """`ending`, or "ok" without one; "non_finite" for NaN or infinity. Unknown inside jit."""
        if not bool(jnp.isfinite(self.image).all()):
            return "non_finite"
        return self.ending or "ok"

    @property
    def has_planes(self) -> bool:
        """Whether the images of several distances are known to be behind each other."""
        return self.pitch is not None and self.pitch.ndim > 0

    def _repr_png_(self) -> bytes:
        """Figure for notebooks: axes in mm, sRGB; planes and a batch side by side."""
        from thincam_jax.plot.frame import as_png
        from thincam_jax.plot.images import draw_result

        return as_png(draw_result(self))


def saying(result: Reconstruction, *reasons: str) -> Reconstruction:
    """A result whose reason is these, those that are not empty."""
    said = "; ".join(filter(None, reasons))
    return dataclasses.replace(result, reason=said) if said else result
