"""How exactly a found design must be built: which of its numbers matters most."""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax.design import DesignSpace, Limits, Variable
from thincam_jax.design.search import Found


class FreeValue(NamedTuple):
    """A free number of a found design.

    - `shots`: that it belongs to, from 1; none for the width, which all share.
    - `tolerance`: the change that makes the objective worse by 1 %; None where none does.
    """

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None


class Around(NamedTuple):
    """First and second derivative of an objective by each free number; NaN where it has no room."""

    slopes: np.ndarray
    curves: np.ndarray


def free_values(
    space: DesignSpace, found: Found, around: Around, rise: float, phases: int
) -> tuple[FreeValue, ...]:
    """What the search chose, and how far each number may be off before `rise` is lost."""
    values = []
    for number, variable in enumerate(space.variables):
        change = least_change(float(around.slopes[number]), float(around.curves[number]), rise)
        shots = shots_of_variable(variable, phases)
        values.append(FreeValue(variable.name, shots, float(found.values[number]), change))
    return tuple(values)


def shots_of_variable(variable: Variable, phases: int) -> tuple[int, ...]:
    """Which shots share it, from 1."""
    return tuple(sorted({c // phases + 1 for c in variable.captures}))


def straight(space: DesignSpace, point) -> tuple[DesignSpace, Any, np.ndarray]:
    """A cube in which one number changes at a time, the point in it, and the lengths of its sides.

    In the search's own, the limit of a mask's pixels ties β to the width; here β ends where it does
    for the width of this design.
    """
    design = space.design(jnp.asarray(point, space.lower.dtype))
    free = DesignSpace(space.base, space.variables, Limits(exposure=space.limits.exposure))
    alone = eqx.tree_at(lambda s: s.upper, free, space.highest(design.width))
    spans = np.asarray(alone.upper - alone.lower, dtype=float)
    return alone, alone.point(design), spans


def per_unit(slopes, curves, spans: np.ndarray) -> Around:
    """From derivatives along the sides of a cube."""
    known = np.where(spans > 0, spans, np.nan)
    return Around(np.asarray(slopes, float) / known, np.asarray(curves, float) / known**2)


@functools.partial(jax.jit, static_argnames="goal")
def _along(goal: Any, space: DesignSpace, data: Any, point):
    def one(direction):
        def value(step):
            return goal(space.design(point + step * direction), data)

        def slope(step):
            return jax.jvp(value, (step,), (jnp.ones_like(step),))[1]

        start = jnp.zeros((), point.dtype)
        return jax.jvp(slope, (start,), (jnp.ones_like(start),))

    return jax.lax.map(one, jnp.eye(len(point), dtype=point.dtype))


def around(goal: Any, space: DesignSpace, data: Any, point) -> Around:
    """By forward differentiation, twice."""
    alone, place, spans = straight(space, point)
    slopes, curves = _along(goal, alone, data, place)
    return per_unit(slopes, curves, spans)


def least_change(slope: float, curve: float, rise: float) -> float | None:
    """The least change that costs `rise`: |slope| δ + curve δ²/2 = rise.

    At an optimum within the bounds there is no slope; at a bound it counts, and is all that counts
    where the curvature is negative.
    """
    slope = abs(slope)
    root = slope**2 + 2 * curve * rise
    if not math.isfinite(root) or root < 0 or slope + math.sqrt(root) == 0:
        return None
    return 2 * rise / (slope + math.sqrt(root))
