"""Pareto fronts of designs: what thickness, captures, light or another cost buys.

Every point of a front is a search of its own over all that is free: from even samples, and once
more near the best design of each point beside it. The design that costs less competes itself, too,
so that what costs more is never worse for want of searching. Designs are compared by the exact
response, all of them on one band of frequencies.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.progress import watched
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.design import Design, Shot
from thincam_jax.design.objectives import ObjectiveData, ResolutionLimit, bayes_error, limit
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.search import NonFiniteObjectiveError, SearchSettings, find_designs
from thincam_jax.design.space import DesignSpace

_TRIED = 3  # of the designs of a search, are scored exactly
_NEAR = 0.15  # of the search's bounds to either side, where a search goes on from the point before


class FrontPoint(eqx.Module):
    """The best design found at one cost.

    - `cost`: in the unit of the front.
    - `resolution`: cycles/rad, up to which every ring's signal-to-noise ratio is at least 1.
    - `ends`: cause other than the signal that ends it, in words; empty where nothing does.
    - `error`: error of the best linear reconstruction, as a part of the scene's variance.
    """

    cost: float
    design: Design
    resolution: float
    ends: str
    error: float

    @property
    def shots(self) -> tuple[Shot, ...]:
        return self.design.shots


@checked
@watched("searching a front")
def find_front(
    problems: Mapping[float, DesignProblem],
    settings: SearchSettings | None = None,
    *,
    key: Key,
    progress: Callable[[float], object] | None = None,
) -> tuple[FrontPoint, ...]:
    """The best design at each cost, in the order of the costs.

    **Arguments**

    - `problems`: by rising cost, what may be designed for it: `DesignProblem.with_thickness`,
      `with_electrons`, `with_captures`, or spaces of your own. Their data are `ObjectiveData` with
      the exact frequencies in common.
    - `settings`: settings of each search. `progress`: called with the cost as a search begins.

    Designs are ranked by their resolution where the objective is `ResolutionLimit`, else by their
    expected error.

    **Errors**: NonFiniteObjectiveError where the objective is NaN at every start of a point.

    `non_dominated` says which points no other one beats.
    """
    search = FrontSearch(problems, settings or SearchSettings(), random_key(key))
    for place, beside in search.order:
        if progress is not None:
            progress(search.costs[place])
        search.advance(place, beside)
    return search.points


class FrontSearch:
    """`find_front` in steps: `advance` through `order`, then read `points`.

    Of equal captures, each point is searched for by itself; then near the next, from the last on;
    then near the one before. Where costs are captures, each is searched for by itself and near the
    one before, whose last shot is repeated.
    """

    def __init__(
        self, problems: Mapping[float, DesignProblem], settings: SearchSettings, key: PRNGKeyArray
    ):
        self.costs = tuple(problems)
        self.problems = tuple(problems.values())
        self.settings, self.key = settings, key
        self._best: dict[int, FrontPoint] = {}

    @property
    def order(self) -> list[tuple[int, int | None]]:
        """Place of each search in the front, and that of the point it begins near, if any."""
        captures = {problem.space.base.captures for problem in self.problems}
        return search_order(len(self.costs), rising_captures=len(captures) > 1)

    @property
    def points(self) -> tuple[FrontPoint, ...]:
        """The best designs so far, by cost."""
        return tuple(self._best[place] for place in sorted(self._best))

    def advance(self, place: int, beside: int | None) -> None:
        """Search for a point near another one's design, or over the whole space."""
        problem, best = self.problems[place], self._best
        near = None if beside is None else best[beside].design
        if near is not None and near.captures != problem.space.base.captures:
            near = _lengthened(near, problem.space.base)
        point = self._improved(problem, near, best.get(place))
        best[place] = dataclasses.replace(point, cost=self.costs[place])

    def _improved(
        self, problem: DesignProblem, near: Design | None, own: FrontPoint | None
    ) -> FrontPoint:
        """The best of a search near another design, of that design, and of `own`.

        Without `own`, of a search over the whole space, too.
        """
        spaces = [problem.space] if own is None else []
        designs: list[Design] = []
        if near is not None:
            place = jnp.clip(problem.space.point(near), 0.0, 1.0)
            spaces.append(neighbourhood(problem.space, place))
            designs.append(problem.space.design(place))
        for space in spaces:
            narrowed = dataclasses.replace(problem.searched, space=space)
            searched = find_designs(narrowed, self.settings, key=self.key)
            designs += [found.design for found in searched.found[:_TRIED]]
        points = [front_point(design, problem.best_data) for design in designs]
        points = _finite(points if own is None else [own, *points])
        if isinstance(problem.objective, ResolutionLimit):
            return min(points, key=lambda p: (-p.resolution, p.error))
        return min(points, key=lambda p: p.error)


def search_order(count: int, *, rising_captures: bool) -> list[tuple[int, int | None]]:
    """`FrontSearch.order` of so many points."""
    if rising_captures:
        return [(n, n - 1 if n else None) for n in range(count)]
    alone = [(n, None) for n in range(count)]
    back = [(n, n + 1) for n in reversed(range(count - 1))]
    return [*alone, *back, *((n, n - 1) for n in range(1, count))]


def _lengthened(design: Design, base: Design) -> Design:
    """A design with its last shot repeated, as often as `base` has captures more."""
    phases = base.phases
    last = range(design.captures - phases, design.captures)
    more = (base.captures - design.captures) // phases
    order = jnp.asarray([*range(design.captures), *(list(last) * more)])
    return eqx.tree_at(
        lambda d: (d.beta, d.distance, d.wavelength, d.width),
        base,
        (design.beta[order], design.distance[order], design.wavelength[order], design.width),
    )


def _finite(points: Iterable[FrontPoint]) -> list[FrontPoint]:
    known = [point for point in points if np.isfinite(point.error)]
    if not known:
        raise NonFiniteObjectiveError(
            "the objective is NaN at any start; give bounds nearer to the reference"
        )
    return known


def neighbourhood(space: DesignSpace, place: Float[Array, " variable"]) -> DesignSpace:
    """The part of a space near a place of its cube, without another compilation.

    Of β, which a mask's pixels tie to the width, the lowest of the widest masks and the highest of
    the narrowest: what it then may have with a width is for the space to say.
    """
    is_width = jnp.asarray([v.name == "width" for v in space.variables])
    step = jnp.where(is_width, -_NEAR, _NEAR).astype(place.dtype)
    less, more = (space.values(jnp.clip(place + s, 0.0, 1.0)) for s in (-step, step))
    lower, upper = jnp.where(is_width, more, less), jnp.where(is_width, less, more)
    return eqx.tree_at(lambda s: (s.lower, s.upper), space, (lower, upper))


def front_point(design: Design, data: ObjectiveData) -> FrontPoint:
    """Resolution and error of a design; no resolution beyond what the pixels sample. No cost."""
    found, error = (float(value) for value in _limit_and_error(design, data))
    edge = float(data.frequencies.highest)
    nyquist = float(jnp.max(design.distance)) / (2 * float(data.setup.pitch))
    ends = "at the band's end" if found >= edge * (1 - 1e-9) else ""
    if nyquist < min(found, edge):
        ends = "at the pixels' Nyquist frequency"
    return FrontPoint(math.nan, design, min(found, edge, nyquist), ends, error)


@eqx.filter_jit
def _limit_and_error(
    design: Design, data: ObjectiveData
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    known = data.channels(design)
    return limit(known, data.frequencies), bayes_error(known)


@checked
def non_dominated(points: Numbers, *, larger: Sequence[bool]) -> Bool[np.ndarray, " point"]:
    """Mask of the points on the Pareto front: no other one beats them in everything.

    A point is dominated by another one that is no worse in every objective and better in at least
    one. Points with the same numbers do not dominate each other; a NaN is on no front and dominates
    nothing.

    **Arguments**: `points`, a row each, in any units; `larger`: for each objective, whether larger
    numbers are better (maximised) or smaller ones (minimised).

    **Returns**: True for each point that no other one dominates.

    **Errors**: ValueError where `larger` has not one entry for each objective.
    """
    points = checks.numbers("points", points)
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
