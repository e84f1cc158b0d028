"""Where float32 is too coarse for a PSF's phases."""

import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.path import LightPath

# Fringes whose phase is known to a twentieth of a radian are wrong by some per cent.
_LARGEST = 0.05 * 2.0**24


def require_digits(mask: AbstractMask, grid: Grid, path: LightPath, model: str) -> None:
    r"""ValueError where float32 cannot represent the phase of the zones on the sensor.

    The fringes of the order k have the phase :math:`k\beta r^2/(M^2(1+k\epsilon))` at r on the
    sensor, :math:`k\beta(1-k\epsilon) r^2/M^2` of "paraxial", which float32 rounds by 2⁻²⁴ of
    itself. More than 0.05 rad is refused: the PSF would be
    wrong by several per cent. Traced numbers are not checked.
    """
    if not held_in_single(mask, grid, path, model):
        phase = largest_phase(mask, grid, path, model)
        raise ValueError(
            f"float32 holds the zones' phase of {phase:.1e} rad on this sensor only to "
            f"{phase * 2.0**-24:.1g} rad; give PsfMethod({model!r}, precision='float64')"
        )


def held_in_single(mask: AbstractMask, grid: Grid, path: LightPath, model: str) -> bool:
    """Whether float32 can represent the zones' phases; True for traced numbers."""
    numbers = jax.tree.leaves((mask, grid, path))
    if not hasattr(mask, "zone_orders") or any(checks.is_traced(n) for n in numbers):
        return True
    return largest_phase(mask, grid, path, model) <= _LARGEST


def largest_phase(mask: Any, grid: Grid, path: LightPath, model: str) -> float:
    """Largest phase, rad, of the orders' fringes where they are strong and light falls."""
    with jax.ensure_compile_time_eval():  # inside jit, sums of known numbers are traced as well
        scale, epsilon = map(float, _scale_and_epsilon(path, mask.beta))
    epsilon = 0.0 if model == "geometric" else epsilon
    beta, halves = float(mask.beta), [float(side) / 2 for side in mask.extent]
    ends = [
        (n - 1) / 2 * float(grid.pitch) / scale + abs(float(c))
        for n, c in zip(grid.shape, np.asarray(mask.centre), strict=True)
    ]
    found = 0.0
    for k in mask.orders:
        if model == "paraxial":  # its phases are those of kβ(1 − kε), which grow with k²ε
            found = max(found, abs(k) * beta * abs(1 - k * epsilon) * sum(r**2 for r in ends))
        gain = abs(1 + k * epsilon)
        if k == 0 or gain == 0 or gain > 2:  # beyond, the order is spread out and weak
            continue
        # A bounded order is seen where its image is: the aperture, shrunk or grown by its focus.
        gain_of_reach = math.inf if model in ("paraxial", "closed_form") else gain
        reach = (min(end, gain_of_reach * half) for end, half in zip(ends, halves, strict=True))
        found = max(found, abs(k) * beta / gain * sum(r**2 for r in reach))
    return found


@jax.jit
def _scale_and_epsilon(path: LightPath, beta: Float[Array, ""]):
    return path.magnification, path.epsilon(beta)
