"""A goal over one or two free numbers: the picture beside which an optimum can be judged."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from thincam_jax.design import Design, DesignSpace, Variable, landscape
from thincam_jax.design_run.sensitivity import shots_of_variable


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
    """Over two of the free numbers, or the only one; None where bounds leave them no room.

    The width comes last, and not beside β where a mask's pixels tie the two: that is no rectangle.
    """
    plane = DesignSpace(best, _shown(space), space.limits)
    variables = plane.variables
    ends = (plane.values(jnp.full(plane.size, end, plane.lower.dtype)) for end in (1.0, 0.0))
    upper, lower = (np.asarray(end, dtype=float) for end in ends)
    spans = upper - lower
    if not np.all(spans > 0):
        return None
    _, found = landscape(goal, plane, data, count, at_a_time=at_a_time)
    place = np.linspace(0.0, 1.0, count)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, shots_of_variable(v, phases)) for v in variables)
    return Landscape(named, axes, np.asarray(found, dtype=float).reshape(shape))


def _shown(space: DesignSpace) -> tuple[Variable, ...]:
    shown = sorted(space.variables, key=lambda v: v.name == "width")[:2]
    names = [v.name for v in shown]
    if space.limits.mask_pixel is not None and names == ["beta", "width"]:
        shown = shown[:1]
    return tuple(shown)
