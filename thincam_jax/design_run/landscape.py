"""A goal over one or two free numbers: the picture beside which an optimum can be judged."""

from typing import Any, NamedTuple

import numpy as np

from thincam_jax.design import Design, DesignSpace, landscape
from thincam_jax.design_run.problem import spans_of
from thincam_jax.design_run.sensitivity import shots_of_variable


class Landscape(NamedTuple):
    """The goal over one or two free numbers, the others as in the best design.

    - `variables`: their names and shots; `axes`: their values; `goal`: (n,) or (n, n), the first
      variable along the first axis.
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
    """Over the first two free numbers, or the only one; None where bounds leave them no room."""
    spans = spans_of(space)[:2]
    if not np.all(spans > 0):
        return None
    variables = space.variables[:2]
    plane = DesignSpace(best, variables, space.limits)
    _, found = landscape(goal, plane, data, count, at_a_time=at_a_time)
    place = np.linspace(0.0, 1.0, count)
    lower = np.asarray(plane.lower, dtype=float)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, shots_of_variable(v, phases)) for v in variables)
    return Landscape(named, axes, np.asarray(found, dtype=float).reshape(shape))
