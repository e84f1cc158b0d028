"""The search, its designs ranked and re-scored exactly, and what surrounds them."""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.precision import allow
from thincam_jax.commands.design.config import DesignConfig, found_name
from thincam_jax.commands.design.landscape import Landscape, landscape_of
from thincam_jax.commands.design.problem import (
    RISE,
    Data,
    Goal,
    Problem,
    build_problem,
    search_problem,
)
from thincam_jax.commands.design.sensitivity import FreeValue, around, free_values
from thincam_jax.commands.design.train import Trained, train, train_steps
from thincam_jax.commands.design.transfer import RINGS, Transfer, modulation_transfer
from thincam_jax.commands.study.config import ConfigError
from thincam_jax.commands.study.target import Progress
from thincam_jax.design import Design, DesignSpace, channels
from thincam_jax.design.objectives import ring_means
from thincam_jax.design.search import APART, Found

_KEPT = 10  # designs that are re-scored and listed


class Shot(NamedTuple):
    """β in rad/mm²; distance, wavelength and mask's width in mm; exposure in the reference's."""

    beta: float
    distance: float
    wavelength: float
    width: float
    exposure: float = 1.0


class Candidate(NamedTuple):
    """A design, its goal (smaller is better) as searched and exactly, and its ring means.

    - `level`: signal-to-noise ratio of each ring.
    - `values`, `status`, `active`: of what was found; empty for the reference.
    - `trained`: the error of the training images, with training.
    """

    name: str
    shots: tuple[Shot, ...]
    searched: float
    exact: float
    level: np.ndarray
    values: tuple[FreeValue, ...] = ()
    status: str = ""
    active: tuple[str, ...] = ()
    trained: float | None = None


class Result(NamedTuple):
    """What a search gave.

    - `edge`: of the frequencies looked at, cycles/rad.
    - `transfers`: the modulation transfer of the reference and of the best design.
    - `training`: what the training gave; None without.
    """

    goal: Goal
    reference: Candidate
    found: tuple[Candidate, ...]
    evaluations: int
    failed: int
    exponent: float
    edge: float
    landscape: Landscape | None
    transfers: tuple[Transfer, Transfer] | None = None
    training: Trained | None = None


def find(config: DesignConfig, progress: Progress) -> Result:
    """The search, in double precision: its objective's fringes are finer than single holds.

    Training, which is not that fine, is in the precision that JAX is set to.
    """
    phases = len(config.reference.method().shot_phases())
    with allow("float64"):
        problem = build_problem(config)
        progress("search")
        searched = search_problem(problem, config.search, config.seed)
        kept = _distinct(problem.space, searched.found, phases)
    trained = None
    if config.train is not None:
        points = [np.asarray(k.point) for k in kept]
        trained = train(config, config.train, problem, points, progress)
    with allow("float64"):
        progress("found designs")
        if trained is None:
            found, best = _rescore(problem, kept, phases)
        else:
            found, best = _rank_trained(problem, trained, phases)
        progress("landscape")
        return _result(config, problem, searched, trained, found, best)


def find_steps(config: DesignConfig) -> int:
    """How many times `find` reports progress."""
    return 3 + train_steps(config.train)


def _result(config: DesignConfig, problem: Problem, searched, trained, found, best) -> Result:
    phases = len(config.reference.method().shot_phases())
    base = problem.space.base
    shots = shots_of_design(base, phases)
    reference = Candidate(config.reference.name, shots, *_score(problem, base))
    if trained is not None:
        reference = reference._replace(trained=trained.reference)
    return Result(
        problem.goal,
        reference,
        found,
        searched.evaluations,
        searched.failed,
        float(problem.data.setup.prior.exponent),
        float(problem.data.frequencies.highest),
        landscape_of(problem.goal, problem.space, problem.data, best, config.search.grid, phases),
        (modulation_transfer(base, problem.exact), modulation_transfer(best, problem.exact)),
        trained,
    )


def _distinct(space: DesignSpace, found: tuple[Found, ...], phases: int) -> tuple[Found, ...]:
    """The best, without those whose shots are only in another order.

    **Errors**: ConfigError where the objective was no number at any start.
    """
    if not found:
        raise ConfigError(
            "search: the objective is no number at any start; give bounds nearer to the reference"
        )
    kept: list[Found] = []
    for one in found:
        if not any(_alike(space, one, other, phases) for other in kept):
            kept.append(one)
        if len(kept) == _KEPT:
            break
    return tuple(kept)


def _rescore(
    problem: Problem, kept: tuple[Found, ...], phases: int
) -> tuple[tuple[Candidate, ...], Design]:
    """The search's designs, ranked exactly; and the first."""
    candidates = [
        _candidate(problem, one, _tolerances(problem, one, phases), phases) for one in kept
    ]
    order = sorted(range(len(kept)), key=lambda n: candidates[n].exact)
    return _named(candidates[n] for n in order), kept[order[0]].design


def _rank_trained(
    problem: Problem, trained: Trained, phases: int
) -> tuple[tuple[Candidate, ...], Design]:
    """The trained designs, by their training error; and the first."""
    space = problem.space
    near = {id(one): around for one, around in zip(trained.found, trained.around, strict=True)}
    candidates, designs = [], []
    for one in _distinct(space, trained.found, phases):
        point = jnp.asarray(np.asarray(one.point), space.lower.dtype)
        exact = one._replace(design=space.design(point), values=space.values(point), point=point)
        rise = RISE * one.objective
        values = free_values(space, exact, near[id(one)], rise, phases)
        candidate = _candidate(problem, exact, values, phases)
        candidates.append(candidate._replace(trained=one.objective))
        designs.append(exact.design)
    return _named(candidates), designs[0]


def _candidate(
    problem: Problem, one: Found, values: tuple[FreeValue, ...], phases: int
) -> Candidate:
    shots, score = shots_of_design(one.design, phases), _score(problem, one.design)
    return Candidate("", shots, *score, values, one.status, one.active)


def _named(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    return tuple(c._replace(name=found_name(k)) for k, c in enumerate(candidates, 1))


def shots_of_design(design: Design, phases: int) -> tuple[Shot, ...]:
    """The numbers of each shot, which takes `phases` captures."""
    numbers = (getattr(design, name) for name in Shot._fields)
    each = np.broadcast_arrays(*(np.asarray(n, dtype=float) for n in numbers))
    rows = zip(*(n[::phases] for n in each), strict=True)
    return tuple(Shot(*(float(n) for n in row)) for row in rows)


def _alike(space: DesignSpace, one: Found, other: Found, phases: int) -> bool:
    """Whether two designs have the same shots, in whatever order."""
    spans = dict.fromkeys(Shot._fields, 0.0)
    for v, lower, upper in zip(space.variables, space.lower, space.upper, strict=True):
        spans[v.name] = max(spans[v.name], float(upper - lower))
    pairs = zip(*(sorted(shots_of_design(f.design, phases)) for f in (one, other)), strict=True)
    return all(
        abs(getattr(a, name) - getattr(b, name)) <= APART * span
        for a, b in pairs
        for name, span in spans.items()
    )


def _score(problem: Problem, design: Design) -> tuple[float, float, np.ndarray]:
    """The goal as searched, exactly, and the signal-to-noise ratio of the rings."""
    searched, _ = _goal_and_rings(problem.goal, design, problem.data)
    exact, level = _goal_and_rings(problem.goal, design, problem.exact)
    return float(searched), float(exact), np.asarray(level)


@eqx.filter_jit
def _goal_and_rings(goal: Goal, design: Design, data: Data):
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    return goal(design, data), ring_means(known, data.frequencies, RINGS)


def _tolerances(problem: Problem, one: Found, phases: int) -> tuple[FreeValue, ...]:
    space, goal = problem.space, problem.goal
    near = around(goal, space, problem.data, one.point)
    return free_values(space, one, near, goal.rise(one.objective), phases)
