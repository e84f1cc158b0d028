"""The search, its designs ranked and re-scored exactly, and what surrounds them."""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._precision import allow
from thincam_jax.config import ConfigError
from thincam_jax.config_design import DesignConfig, found_name
from thincam_jax.design import Design, DesignSpace, Variable, channels, landscape, search
from thincam_jax.design.objectives import ring_means
from thincam_jax.design.search import APART, Found
from thincam_jax.design_run.problem import Data, Goal, Problem, build_problem
from thincam_jax.study.target import Progress

FIND_STEPS = 3  # progress that `find` reports
_KEPT = 10  # designs that are re-scored and listed
_RINGS = 64


class Shot(NamedTuple):
    """β in rad/mm² and distance in mm."""

    beta: float
    distance: float


class FreeValue(NamedTuple):
    """A free number of a found design.

    - `shots`: that it belongs to, from 1.
    - `tolerance`: the change that makes the objective worse by 1 %; None where none does.
    """

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None


class Candidate(NamedTuple):
    """A design, its goal (smaller is better) as searched and exactly, and its ring means.

    - `level`: signal-to-noise ratio of each ring.
    - `values`, `status`, `active`: of what was found; empty for the reference.
    """

    name: str
    shots: tuple[Shot, ...]
    searched: float
    exact: float
    level: np.ndarray
    values: tuple[FreeValue, ...] = ()
    status: str = ""
    active: tuple[str, ...] = ()


class Landscape(NamedTuple):
    """The goal over one or two free numbers, the others as in the best design.

    - `variables`: their names and shots; `axes`: their values; `goal`: (n,) or (n, n), the first
      variable along the first axis.
    """

    variables: tuple[tuple[str, tuple[int, ...]], ...]
    axes: tuple[np.ndarray, ...]
    goal: np.ndarray


class Result(NamedTuple):
    """What a search gave; `edge`: of the frequencies looked at, cycles/rad."""

    goal: Goal
    reference: Candidate
    found: tuple[Candidate, ...]
    evaluations: int
    failed: int
    exponent: float
    edge: float
    landscape: Landscape | None


def find(config: DesignConfig, progress: Progress) -> Result:
    """In double precision: the objective's fringes are finer than single precision holds."""
    with allow("float64"):
        problem = build_problem(config)
        progress("search")
        wanted = config.search
        searched = search(
            problem.goal,
            problem.space,
            problem.data,
            key=jax.random.key(config.seed),
            starts=wanted.starts,
            samples=wanted.samples,
            steps=wanted.steps,
            solver=wanted.solver,
        )
        progress("found designs")
        phases = len(config.reference.method().shot_phases())
        found, best = _rescore(problem, searched.found, phases)
        progress("landscape")
        around = _landscape(problem, best, wanted.grid, phases)
        base = problem.space.base
        reference = Candidate(config.reference.name, _shots(base, phases), *_score(problem, base))
        return Result(
            problem.goal,
            reference,
            found,
            searched.evaluations,
            searched.failed,
            float(problem.data.setup.prior.exponent),
            float(problem.data.frequencies.highest),
            around,
        )


def _rescore(
    problem: Problem, found: tuple[Found, ...], phases: int
) -> tuple[tuple[Candidate, ...], Design]:
    """The best, without those whose shots are only in another order, ranked exactly; and the first.

    **Errors**: ConfigError where the objective was no number at any start.
    """
    if not found:
        raise ConfigError(
            "search: the objective is no number at any start; give bounds nearer to the reference"
        )
    kept: list[Found] = []
    for one in found:
        if not any(_alike(problem.space, one, other, phases) for other in kept):
            kept.append(one)
        if len(kept) == _KEPT:
            break
    candidates = [
        Candidate(
            "",
            _shots(one.design, phases),
            *_score(problem, one.design),
            _free_values(problem, one, phases),
            one.status,
            one.active,
        )
        for one in kept
    ]
    order = sorted(range(len(kept)), key=lambda n: candidates[n].exact)
    ranked = (candidates[n]._replace(name=found_name(k)) for k, n in enumerate(order, 1))
    return tuple(ranked), kept[order[0]].design


def _shots(design: Design, phases: int) -> tuple[Shot, ...]:
    numbers = (design.beta, design.distance)
    beta, distance = (np.asarray(n, dtype=float)[::phases] for n in numbers)
    return tuple(Shot(float(b), float(d)) for b, d in zip(beta, distance, strict=True))


def _alike(space: DesignSpace, one: Found, other: Found, phases: int) -> bool:
    """Whether two designs have the same shots, in whatever order."""
    spans = {"beta": 0.0, "distance": 0.0}
    for v, lower, upper in zip(space.variables, space.lower, space.upper, strict=True):
        spans[v.name] = max(spans[v.name], float(upper - lower))
    pairs = zip(*(sorted(_shots(f.design, phases)) for f in (one, other)), strict=True)
    return all(
        abs(a.beta - b.beta) <= APART * spans["beta"]
        and abs(a.distance - b.distance) <= APART * spans["distance"]
        for a, b in pairs
    )


def _score(problem: Problem, design: Design) -> tuple[float, float, np.ndarray]:
    """The goal as searched, exactly, and the signal-to-noise ratio of the rings."""
    searched, _ = _goal_and_rings(problem.goal, design, problem.data)
    exact, level = _goal_and_rings(problem.goal, design, problem.exact)
    return float(searched), float(exact), np.asarray(level)


@eqx.filter_jit
def _goal_and_rings(goal: Goal, design: Design, data: Data):
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    return goal(design, data), ring_means(known, data.frequencies, _RINGS)


def _free_values(problem: Problem, found: Found, phases: int) -> tuple[FreeValue, ...]:
    space = problem.space
    spans = _spans(space)
    slopes, curves = _along(problem.goal, space, problem.data, found.point)
    values = []
    for number, variable in enumerate(space.variables):
        span = float(spans[number])
        change = None
        if span > 0:
            rise = problem.goal.rise(found.objective)
            change = _change(float(slopes[number]) / span, float(curves[number]) / span**2, rise)
        shots = _shots_of(variable, phases)
        values.append(FreeValue(variable.name, shots, float(found.values[number]), change))
    return tuple(values)


def _spans(space: DesignSpace) -> np.ndarray:
    """What a side of the cube is in the variables' units; straight, for the width is not free."""
    ends = (space.values(jnp.full(space.size, end, space.lower.dtype)) for end in (1.0, 0.0))
    upper, lower = (np.asarray(end, dtype=float) for end in ends)
    return upper - lower


def _shots_of(variable: Variable, phases: int) -> tuple[int, ...]:
    return tuple(sorted({c // phases + 1 for c in variable.captures}))


@functools.partial(jax.jit, static_argnames="goal")
def _along(goal: Goal, space: DesignSpace, data: Data, point):
    """First and second derivative of the goal along each side of the cube."""

    def one(direction):
        def value(step):
            return goal(space.design(point + step * direction), data)

        def slope(step):
            return jax.jvp(value, (step,), (jnp.ones_like(step),))[1]

        start = jnp.zeros((), point.dtype)
        return jax.jvp(slope, (start,), (jnp.ones_like(start),))

    return jax.lax.map(one, jnp.eye(len(point), dtype=point.dtype))


def _change(slope: float, curve: float, rise: float) -> float | None:
    """The least change that costs `rise`: |slope| δ + curve δ²/2 = rise.

    At an optimum within the bounds there is no slope; at a bound it counts, and is all that counts
    where the curvature is negative.
    """
    slope = abs(slope)
    root = slope**2 + 2 * curve * rise
    if not math.isfinite(root) or root < 0 or slope + math.sqrt(root) == 0:
        return None
    return 2 * rise / (slope + math.sqrt(root))


def _landscape(problem: Problem, best: Design, count: int, phases: int) -> Landscape | None:
    """Over the first two free numbers, or the only one; None where bounds leave them no room."""
    space = problem.space
    spans = _spans(space)[:2]
    if not np.all(spans > 0):
        return None
    variables = space.variables[:2]
    plane = DesignSpace(best, variables, space.limits)
    _, goal = landscape(problem.goal, plane, problem.data, count)
    place = np.linspace(0.0, 1.0, count)
    lower = np.asarray(plane.lower, dtype=float)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, _shots_of(v, phases)) for v in variables)
    return Landscape(named, axes, np.asarray(goal, dtype=float).reshape(shape))
