"""What surrounds a found design: how exactly it must be built, and the objective's landscape."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.checks import Numbers
from thincam_jax.commands.design.problem import phases_of
from thincam_jax.design import Design, DesignSpace, Limits, Variable, landscape
from thincam_jax.design.search import Found


@dataclass(frozen=True)
class FreeValue:
    """A free number of a found design.

    - `shots`: that it belongs to, from 1; none for the width, which all share.
    - `tolerance`: the change that makes the objective worse by 1 %; None where none does.
    """

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None


@dataclass(frozen=True, eq=False)
class Derivatives:
    """First and second derivative of an objective by each free number; NaN where it has no room."""

    slopes: np.ndarray
    curves: np.ndarray


def free_values(
    space: DesignSpace, found: Found, near: Derivatives, rise: float
) -> tuple[FreeValue, ...]:
    """What the search chose, and how far each number may be off before `rise` is lost."""
    each = zip(space.variables, found.values, near.slopes, near.curves, strict=True)
    return tuple(
        FreeValue(
            variable.name,
            _shots_of(variable, space.base),
            float(value),
            least_change(float(slope), float(curve), rise),
        )
        for variable, value, slope, curve in each
    )


def _shots_of(variable: Variable, design: Design) -> tuple[int, ...]:
    """Which shots share it, from 1; none for the width."""
    phases = phases_of(design)
    return tuple(sorted({c // phases + 1 for c in variable.captures}))


def straight(space: DesignSpace, point: Numbers) -> tuple[DesignSpace, Any, np.ndarray]:
    """A cube in which one number changes at a time, the point in it, and the lengths of its sides.

    In the search's own, the limit of a mask's pixels ties β to the width; here β ends where it does
    for the width of this design.
    """
    design = space.design(jnp.asarray(point, space.lower.dtype))
    free = DesignSpace(space.base, space.variables, Limits(exposure=space.limits.exposure))
    alone = eqx.tree_at(lambda s: s.upper, free, space.highest(design.width))
    spans = np.asarray(alone.upper - alone.lower, dtype=float)
    return alone, alone.point(design), spans


def per_unit(slopes: Numbers, curves: Numbers, spans: np.ndarray) -> Derivatives:
    """From derivatives along the sides of a cube."""
    known = np.where(spans > 0, spans, np.nan)
    return Derivatives(np.asarray(slopes, float) / known, np.asarray(curves, float) / known**2)


@functools.partial(jax.jit, static_argnames="objective")
def _along(objective: Any, space: DesignSpace, data: Any, point):
    def one(direction):
        def value(step):
            return objective(space.design(point + step * direction), data)

        def slope(step):
            return jax.jvp(value, (step,), (jnp.ones_like(step),))[1]

        start = jnp.zeros((), point.dtype)
        return jax.jvp(slope, (start,), (jnp.ones_like(start),))

    return jax.lax.map(one, jnp.eye(len(point), dtype=point.dtype))


def derivatives(objective: Any, space: DesignSpace, data: Any, point: Numbers) -> Derivatives:
    """By forward differentiation, twice."""
    alone, place, spans = straight(space, point)
    slopes, curves = _along(objective, alone, data, place)
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


@dataclass(frozen=True, eq=False)
class Landscape:
    """The objective over one or two free numbers, the others as in the best design.

    - `variables`: their names and shots (none for the width); `axes`: their values.
    - `values`: (n,) or (n, n), the first variable along the first axis.
    """

    variables: tuple[tuple[str, tuple[int, ...]], ...]
    axes: tuple[np.ndarray, ...]
    values: np.ndarray


def landscape_of(
    objective: Any,
    space: DesignSpace,
    data: Any,
    best: Design,
    count: int,
    *,
    at_a_time: int = 32,
) -> Landscape | None:
    """Over two of the free numbers, or the only one; None where there is none to draw, or no room.

    See `shown`.
    """
    drawn = shown(space)
    if not drawn:
        return None
    plane = DesignSpace(best, drawn, space.limits)
    variables = plane.variables
    ends = (plane.lower, plane.highest(best.width))
    lower, upper = (np.asarray(end, dtype=float) for end in ends)
    spans = upper - lower
    if not np.all(spans > 0):
        return None
    _, found = landscape(objective, plane, data, count, at_a_time=at_a_time)
    place = np.linspace(0.0, 1.0, count)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, _shots_of(v, best)) for v in variables)
    return Landscape(named, axes, np.asarray(found, dtype=float).reshape(shape))


def shown(space: DesignSpace) -> tuple[Variable, ...]:
    """The first two variables whose change leaves the others as they are.

    Not the width beside a β that a mask's pixels tie to it, and none of several exposures that
    share one with a third.
    """
    last = sorted(space.variables, key=lambda v: v.name == "width")
    exposures = sum(v.name == "exposure" for v in last)
    if exposures > 2 or exposures == 2 and len(last) > 2:
        last = [v for v in last if v.name != "exposure"]
    if space.limits.mask_pixel is not None and [v.name for v in last[:2]] == ["beta", "width"]:
        last = last[:1]
    return tuple(last[:2])
