"""Ranking of the designs that a search or a training found, with their tolerances."""

from collections.abc import Iterable
from dataclasses import fields, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax.design.design import Design, Shot
from thincam_jax.design.objectives import ObjectiveData, ring_means
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import SEPARATION, Found, NonFiniteObjectiveError
from thincam_jax.design.sensitivity import FreeValue, derivatives, one_percent, with_tolerances
from thincam_jax.design.space import DesignSpace
from thincam_jax.design.training_search import TrainedDesigns
from thincam_jax.design.transfer import RINGS

_KEPT = 10  # designs that are ranked


class RankedDesign(eqx.Module):
    """A design, its costs (smaller is better) in the search and exactly, and its ring means.

    - `level`: signal-to-noise ratio of each ring.
    - `values`, `status`, `active`: free numbers, end of the descent and active limits of a design
      found; empty for a reference.
    - `trained`: the error of the training images, with training.
    """

    name: str
    design: Design
    searched: float
    exact: float
    level: np.ndarray
    values: tuple[FreeValue, ...] = ()
    status: str = ""
    active: tuple[str, ...] = ()
    trained: float | None = None

    @property
    def shots(self) -> tuple[Shot, ...]:
        return self.design.shots


def rank_designs(problem: DesignProblem, found: tuple[Found, ...]) -> tuple[RankedDesign, ...]:
    """Designs of a search, ranked by the exact objective, with their tolerances.

    The first ten that differ in more than the order of their shots. `problem.data` are
    `ObjectiveData`.

    **Errors**: NonFiniteObjectiveError where nothing was found.
    """
    ranked = []
    for one in distinct_designs(problem.space, found):
        scored = score_design(problem, one.design)
        near = derivatives(problem.objective, problem.space, problem.best_data, one.point)
        increase = one_percent(problem.objective, scored.exact)
        values = with_tolerances(problem.space, one, near, increase).values
        ranked.append(replace(scored, values=values, status=one.status, active=one.active))
    return _named(sorted(ranked, key=lambda design: design.exact))


def rank_trained(problem: DesignProblem, trained: TrainedDesigns) -> tuple[RankedDesign, ...]:
    """Trained designs, ranked by their training error, with the tolerances of that."""
    space = problem.space
    near = {id(one): own for one, own in zip(trained.found, trained.near, strict=True)}
    ranked = []
    for one in distinct_designs(space, trained.found):
        point = jnp.asarray(np.asarray(one.point), space.lower.dtype)
        exact = replace(one, design=space.design(point), values=space.values(point), point=point)
        increase = one_percent(trained.objective, one.objective)
        values = with_tolerances(space, exact, near[id(one)], increase).values
        scored = replace(score_design(problem, exact.design), values=values, status=one.status)
        ranked.append(replace(scored, active=one.active, trained=one.objective))
    return _named(ranked)


def found_name(rank: int) -> str:
    """Name of the design of a rank, from 1."""
    return f"found {rank}"


def _named(ranked: Iterable[RankedDesign]) -> tuple[RankedDesign, ...]:
    return tuple(replace(one, name=found_name(k)) for k, one in enumerate(ranked, 1))


def distinct_designs(space: DesignSpace, found: tuple[Found, ...]) -> tuple[Found, ...]:
    """The first ten designs, without those whose shots are only in another order.

    **Errors**: NonFiniteObjectiveError where there is none.
    """
    if not found:
        raise NonFiniteObjectiveError(
            "the objective is NaN at any start; give bounds nearer to the reference"
        )
    kept: list[Found] = []
    for one in found:
        if not any(_alike(space, one, other) for other in kept):
            kept.append(one)
        if len(kept) == _KEPT:
            break
    return tuple(kept)


def _alike(space: DesignSpace, one: Found, other: Found) -> bool:
    """Whether two designs have the same shots, in whatever order."""
    spans = dict.fromkeys((field.name for field in fields(Shot)), 0.0)
    for v, lower, upper in zip(space.variables, space.lower, space.upper, strict=True):
        spans[v.name] = max(spans.get(v.name, 0.0), float(upper - lower))
    spans.pop("phase", None)
    pairs = zip(*(sorted(f.design.shots) for f in (one, other)), strict=True)
    return all(
        abs(getattr(a, name) - getattr(b, name)) <= SEPARATION * span
        for a, b in pairs
        for name, span in spans.items()
    )


@checked
def score_design(problem: DesignProblem, design: Design, name: str = "") -> RankedDesign:
    """Costs of a design in the search and exactly, and the signal-to-noise ratio of its rings."""
    searched, _ = _cost_and_rings(problem.objective, design, problem.data)
    exact, level = _cost_and_rings(problem.objective, design, problem.best_data)
    return RankedDesign(name, design, float(searched), float(exact), np.asarray(level))


@eqx.filter_jit
def _cost_and_rings(objective: Objective, design: Design, data: ObjectiveData):
    known = data.channels(design)
    return objective(design, data), ring_means(known, data.frequencies, RINGS)
