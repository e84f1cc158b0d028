"""Reconstructed images."""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.module import Module
from thincam_jax._core.quantity import unchecked
from thincam_jax.reconstruction.iterate import Outcome, Progress


class Reconstruction(Module):
    """A reconstructed image; with cameras upright as the scene is, otherwise as the captures are.

    - `image`: radiance, (*batch, y, x), in the scene's unit; (*batch, plane, y, x) with planes.
    - `pitch`: distance of its pixels on the object, mm (of each plane); None without cameras.
    - `method`, `reason`: how it was made, and why so if that was left to `choose_solver`, or what
      was noticed when τ was left to a rule.
    - `ended`: how an iteration ended, in the words of `status`.
    - `history`: objective and residuals along the way; see `Progress`.
    - `iterations`, `seconds`: done and taken; compilation is part of the time.
    - `tau`: the relative τ used, as given or found; None for methods without.
    """

    image: Float[Array, "*batch y x"]
    pitch: Float[Array, "*plane"] | None = eqx.field(converter=unchecked("mm"))
    method: str = eqx.field(static=True, default="")
    reason: str = eqx.field(static=True, default="")
    ended: str = eqx.field(static=True, default="ok")
    history: tuple[Progress, ...] = eqx.field(static=True, default=(), repr=False)
    iterations: int = eqx.field(static=True, default=0)
    seconds: float = eqx.field(static=True, default=0.0)
    tau: float | None = eqx.field(static=True, default=None)

    @property
    def status(self) -> str:
        """Status of the image, unknown inside jit.

        "ok" in closed form; of an iteration "converged", "iterations_exhausted", "stopped" by the
        callback or "interrupted" by Ctrl-C; "non_finite" for NaN or infinity.
        """
        return self.ended if bool(jnp.isfinite(self.image).all()) else "non_finite"

    @property
    def ending(self) -> str:
        """The status in a sentence; of iterations exhausted, by how much the last ones gained."""
        if self.status != "iterations_exhausted":
            words = self.status.replace("_", " ")
            return f"{words} after {self.iterations} iterations" if self.iterations else words
        words = f"stopped after {self.iterations} iterations"
        if len(self.history) < 3:  # of one compiled program only start and end are known
            return words
        last, end = self.history[-2:]
        fall = (last.objective - end.objective) / abs(last.objective or 1.0)
        gain = 100 * max(fall, 0.0) / (end.iteration - last.iteration)
        return f"{words}; the objective still fell by {gain:.2g} % an iteration"

    @property
    def has_planes(self) -> bool:
        """Whether the images of several distances are known to be behind each other."""
        return self.pitch is not None and self.pitch.ndim > 0

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The image, for NumPy and what takes its arrays, such as `matplotlib.pyplot.imshow`."""
        return np.array(self.image, dtype, copy=copy)

    def _repr_png_(self) -> bytes:
        """Figure for notebooks: axes in mm, sRGB; planes and a batch side by side."""
        from thincam_jax.plot.frame import as_png
        from thincam_jax.plot.images import draw_result

        return as_png(draw_result(self))


AnyResult = TypeVar("AnyResult", Reconstruction, Outcome)


def saying(result: AnyResult, *reasons: str) -> AnyResult:
    """A result whose reason is these, those that are not empty."""
    said = "; ".join(filter(None, reasons))
    return dataclasses.replace(result, reason=said) if said else result
