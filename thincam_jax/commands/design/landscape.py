"""A goal over one or two free numbers: the picture beside which an optimum can be judged."""

from typing import Any, NamedTuple

import numpy as np

from thincam_jax.commands.design.sensitivity import shots_of_variable
from thincam_jax.design import Design, DesignSpace, Variable, landscape


class Landscape(NamedTuple):
    """The goal over one or two free numbers, the others as in the best design.

    - `variables`: their names and shots (none for the width); `axes`: their values.
    - `goal`: (n,) or (n, n), the first variable along the first axis.
    """

    variables: tuple[tuple[str, tuple[int, ...]], ...]
    axes: tuple[np.ndarray, ...]
    goal: np.ndarray


def landscape_of(
    goal: Any,
    space: DesignSpace,
    data: Any,
    best: Design,
    count: int,
    phases: int,
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
    _, found = landscape(goal, plane, data, count, at_a_time=at_a_time)
    place = np.linspace(0.0, 1.0, count)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, shots_of_variable(v, phases)) for v in variables)
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
