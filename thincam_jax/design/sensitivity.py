r"""Sensitivity around an optimum: how exactly each number of a design must be built.

The tolerance of a number is the change δ that increases the objective by 1 %, the others held,

.. math:: |s|\,\delta + \tfrac12 c\,\delta^2 = \Delta

with the slope s, the curvature c and that increase Δ.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax.design.objectives import AbstractObjective
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import SEPARATION, Found, evaluate
from thincam_jax.design.space import QUANTITIES, REPORTED, DesignSpace, Limits

_ONE_PERCENT = 0.01


@dataclass(frozen=True)
class FreeValue:
    """A free number of a design, in the package's unit.

    - `shots`: shots with this number, from 1; none for the width, which all share.
    - `tolerance`: the change that makes the objective worse by 1 %; None where none does.
    """

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None
    unit: str = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "unit", QUANTITIES[self.variable].unit)

    def __str__(self) -> str:
        """Value and tolerance as reported: "20.18 (±0.35)"."""
        shown = REPORTED[self.variable]
        text = f"{self.value * shown.scale:{shown.form}}"
        if self.tolerance is None:
            return text
        return f"{text} (±{self.tolerance * shown.scale:.2g})"


@dataclass(frozen=True, eq=False)
class Derivatives:
    """First and second derivative of a cost by each free number; NaN where it has no room."""

    slopes: np.ndarray
    curvatures: np.ndarray


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Tolerances of the free numbers of a design, and the derivatives that they follow from.

    - `increase`: increase of the cost, counted as 1 % worse.
    """

    values: tuple[FreeValue, ...]
    derivatives: Derivatives
    increase: float

    def __str__(self) -> str:
        """A line for each number: "β of shot 1, rad/mm²: 20.18 (±0.35)"."""
        return "\n".join(f"{REPORTED[v.variable].of_shots(v.shots)}: {v}" for v in self.values)


@checked
def sensitivity_around(problem: DesignProblem, found: Found) -> Sensitivity:
    """Sensitivity of a problem's objective around a design found, by its ranking data."""
    objective, data = problem.objective, problem.best_data
    cost = float(eqx.filter_jit(objective)(found.design, data))
    near = derivatives(objective, problem.space, data, found.point)
    return with_tolerances(problem.space, found, near, one_percent(objective, cost))


def one_percent(objective: Objective, cost: float) -> float:
    """Increase of a cost counted as 1 % worse."""
    if isinstance(objective, AbstractObjective):
        return objective.increase(cost)
    return _ONE_PERCENT * abs(cost)


def with_tolerances(
    space: DesignSpace, found: Found, near: Derivatives, increase: float
) -> Sensitivity:
    """Sensitivity from derivatives of the cost around a design found."""
    each = zip(space.variables, found.values, near.slopes, near.curvatures, strict=True)
    values = tuple(
        FreeValue(
            variable.name,
            variable.shots(space.base),
            float(value),
            least_change(float(slope), float(curvature), increase),
        )
        for variable, value, slope, curvature in each
    )
    return Sensitivity(values, near, increase)


def uncoupled(space: DesignSpace, point: Numbers) -> tuple[DesignSpace, Any, np.ndarray]:
    """A cube in which one number changes at a time, the point in it, and the lengths of its sides.

    In the search's own, the limit of a mask's pixels ties β to the width; here β ends where it does
    for the width of this design.
    """
    design = space.design(jnp.asarray(point, space.lower.dtype))
    free = DesignSpace(space.base, space.variables, Limits(exposure=space.limits.exposure))
    alone = eqx.tree_at(lambda s: s.upper, free, space.highest(design.width))
    spans = np.asarray(alone.upper - alone.lower, dtype=float)
    return alone, alone.point(design), spans


def derivatives(objective: Objective, space: DesignSpace, data: Any, point: Numbers) -> Derivatives:
    """Derivatives by differences as wide as optima are apart: objectives have finer ripples.

    Those of fringes that pass frequencies are of some 0.01 dB, and have any slope and curvature. At
    a bound they are those of the nearest point that has room on either side.
    """
    alone, place, spans = uncoupled(space, point)
    middle = np.clip(np.asarray(place, float), SEPARATION, 1 - SEPARATION)
    steps = SEPARATION * np.eye(len(middle))
    points = np.concatenate([middle[None], middle + steps, middle - steps])
    points = jnp.asarray(points, alone.lower.dtype)
    values = evaluate(objective, alone, data, points, at_a_time=1)
    level, up, down = np.split(np.asarray(values, float), [1, 1 + len(middle)])
    slopes, curvatures = (up - down) / (2 * SEPARATION), (up - 2 * level + down) / SEPARATION**2
    # Relative to the numbers, along the sides of the cube.
    known = np.where(spans > 0, spans, np.nan)
    return Derivatives(slopes / known, curvatures / known**2)


def least_change(slope: float, curvature: float, increase: float) -> float | None:
    """Least change that costs `increase`: |slope| δ + curvature δ²/2 = increase.

    At an optimum within the bounds there is no slope; at a bound it counts, and is all that counts
    where the curvature is negative.
    """
    slope = abs(slope)
    root = slope**2 + 2 * curvature * increase
    if not math.isfinite(root) or root < 0 or slope + math.sqrt(root) == 0:
        return None
    return 2 * increase / (slope + math.sqrt(root))
