"""How exactly a found design must be built: which of its numbers matters most."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax.design import DesignSpace, Variable
from thincam_jax.design.search import Found
from thincam_jax.design_run.problem import spans_of


class FreeValue(NamedTuple):
    """A free number of a found design.

    - `shots`: that it belongs to, from 1.
    - `tolerance`: the change that makes the objective worse by 1 %; None where none does.
    """

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None


class Around(NamedTuple):
    """First and second derivative of an objective along each side of the cube."""

    slopes: np.ndarray
    curves: np.ndarray


def free_values(
    space: DesignSpace, found: Found, around: Around, rise: float, phases: int
) -> tuple[FreeValue, ...]:
    """What the search chose, and how far each number may be off before `rise` is lost."""
    values = []
    for number, (variable, span) in enumerate(zip(space.variables, spans_of(space), strict=True)):
        change = None
        if span > 0:
            slope, curve = (float(a[number]) for a in around)
            change = least_change(slope / span, curve / span**2, rise)
        shots = shots_of_variable(variable, phases)
        values.append(FreeValue(variable.name, shots, float(found.values[number]), change))
    return tuple(values)


def shots_of_variable(variable: Variable, phases: int) -> tuple[int, ...]:
    """Which shots share it, from 1."""
    return tuple(sorted({c // phases + 1 for c in variable.captures}))


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
    return Around(*(np.asarray(d) for d in _along(goal, space, data, point)))


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
