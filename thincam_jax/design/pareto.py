"""Designs that no other design beats in everything."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float


def non_dominated(
    points: Float[np.ndarray, "point objective"], *, larger: Sequence[bool]
) -> Bool[np.ndarray, " point"]:
    """Which points lie on the Pareto front.

    A point is dominated by another one that is no worse in every objective and better in at least
    one. Points with the same numbers do not dominate each other; a NaN is on no front and dominates
    nothing.

    **Arguments**: `points`, a row each, in any units; `larger`: for each objective, whether larger
    numbers are better (maximised) or smaller ones (minimised).

    **Returns**: True for each point that no other one dominates.

    **Errors**: ValueError where `larger` has not one entry for each objective.
    """
    if points.ndim != 2 or points.shape[1] != len(larger):
        raise ValueError(
            f"points have shape {points.shape} and larger has {len(larger)} entries; give "
            "(point, objective) and one entry for each objective"
        )
    costs = np.where(np.asarray(larger, dtype=bool), -points, points)
    known = ~np.any(np.isnan(costs), axis=1)
    front = known.copy()
    for index in np.flatnonzero(known):
        no_worse = np.all(costs <= costs[index], axis=1)
        better = np.any(costs < costs[index], axis=1)
        front[index] = not np.any(no_worse & better)
    return front
