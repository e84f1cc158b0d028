r"""Search for the best design by gradient: many starts at a time, in one compiled program.

Objectives of a design have many local optima: fringes of several captures beat against each other.
So the cube is first sampled evenly, and descents begin at the best of the samples. Where what is
descended on is an approximation, the best few are then improved on the exact objective.
"""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.module import Module
from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import whole
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.design import Design
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.space import DesignSpace, active_limits
from thincam_jax.reconstruction.iterate import Status

Solver = Literal["bfgs", "lbfgsb"]
# Optima closer than this in the unit cube are one.
SEPARATION = 0.02


@checked
@dataclass(frozen=True)
class SearchSettings:
    """Length of a search, and its solver.

    - `starts`: descents; `samples`: points of the even (scrambled Sobol) sampling before, from
      which those start that are lowest among their neighbours; at least `starts`.
    - `steps`: at most, of each descent.
    - `solver`: "bfgs" (optimistix), under the smooth map sin² onto the cube, or "lbfgsb" (jaxopt)
      within its faces.
    - `tolerance`: relative change of the objective and absolute change in the cube at the end.
    - `separation`: optima closer than this in the cube are one.

    **Errors**: ValueError for numbers of starts, samples or steps out of range.
    """

    starts: Annotated[int, whole(1, 1000)] = 16
    samples: Annotated[int, whole(1, 100_000)] = 512
    steps: Annotated[int, whole(1, 1000)] = 60
    solver: Solver = "bfgs"
    tolerance: float = 1e-6
    separation: float = SEPARATION

    def __post_init__(self):
        checks.choice("solver", self.solver, get_args(Solver))


class NonFiniteObjectiveError(ValueError):
    """The objective is NaN or infinite at every start of a search."""


class Descents(eqx.Module):
    """End of one descent, or of each of many, and the evaluations of the objective it took."""

    points: Float[Array, "*start variable"]
    values: Float[Array, "*start"]
    evaluations: Int[Array, "*start"]
    converged: Bool[Array, "*start"]


class Found(Module):
    """A local optimum.

    - `design`; `values`: its free numbers, in the order of the space's variables, and `named`:
      the same by name and unit, as "β of shot 1, rad/mm²".
    - `objective`: its value there.
    - `status`: end of the descent that led there.
    - `active`: the limits it lies against, in words.
    - `point`: in the unit cube.
    """

    design: Design
    values: Float[Array, " variable"] = eqx.field(repr=False)
    objective: float
    status: Status
    active: tuple[str, ...]
    point: Float[Array, " variable"]
    named: dict[str, float] = eqx.field(default_factory=dict)


class Search(Module):
    """The optima found, best first, without those that repeat a better one.

    - `evaluations`: number of evaluations of the objective, with or without its gradient: all
      samples, each descent up to its own end and those of the improvement.
    - `failed`: number of samples and descents that met an objective that is not finite.
    """

    found: tuple[Found, ...]
    evaluations: int
    failed: int


@checked
@watched("searching designs")
def find_designs(
    problem: DesignProblem, settings: SearchSettings | None = None, *, key: Key
) -> Search:
    """Designs of a space where an objective is smallest.

    Where the problem has `exact` data, the best few optima and the best sample are improved on
    them, and all designs found are ranked by them.
    """
    key = random_key(key)
    settings = settings or SearchSettings()
    objective, space, data = problem.objective, problem.space, problem.data
    points, values = sampled(objective, space, data, max(settings.samples, settings.starts), key)
    chosen = best_apart(np.asarray(points), np.asarray(values), settings.starts)
    descend = _descend if settings.solver == "bfgs" else _descend_in_box
    tolerance = jnp.asarray(settings.tolerance, points.dtype)
    scales = _scale(values[chosen])
    ended = descend(problem.searched, points[chosen], scales, settings.steps, tolerance)
    search = search_of(space, values, ended, settings.separation)
    if problem.exact is None or not search.found:
        return search
    begun = np.stack([*(one.point for one in search.found), points[chosen[0]]])
    better, more = improved(problem, begun, [one.status for one in search.found])
    found = without_repeats(better, settings.separation)
    return Search(found, search.evaluations + more, search.failed)


def sampled(
    objective: Objective, space: DesignSpace, data: Any, count: int, key: PRNGKeyArray
) -> tuple[Float[Array, "point variable"], Float[Array, " point"]]:
    """Even samples of the unit cube, and the objective there."""
    points = even_samples(space.size, count, key, space.lower.dtype)
    return points, evaluate(objective, space, data, points)


def search_of(
    space: DesignSpace, values: Float[Array, " point"], ended: Descents, separation: float
) -> Search:
    """The search of which these are the samples' values and the ends of its descents."""
    ended = jax.device_get(ended)
    failed = sum(int(np.sum(~np.isfinite(v))) for v in (np.asarray(values), ended.values))
    used = len(values) + int(np.sum(ended.evaluations))
    return Search(ranked(space, ended, separation), used, failed)


_GRADIENT = 3  # evaluations that one with its gradient counts as


def random_search(
    problem: DesignProblem, search: Search, settings: SearchSettings, *, key: Key
) -> tuple[Design, int]:
    """The best of random designs at the cost of a search, and how many there were.

    An evaluation of a descent counts as three, for its gradient. The samples that are best by the
    problem's data are ranked by its exact ones, where it has them.
    """
    batch = max(settings.samples, settings.starts)
    count = batch + _GRADIENT * max(search.evaluations - batch, 0)
    return best_random(problem, count, batch, random_key(key)), count


def best_random(problem: DesignProblem, count: int, batch: int, key: PRNGKeyArray) -> Design:
    """The best of so many random designs, evaluated in batches, as of `random_search`."""
    space = problem.space
    every = jax.random.uniform(key, (count, space.size), space.lower.dtype)
    # In parts as large as the search's samples, whose program they share.
    whole = jnp.pad(every, ((0, -count % batch), (0, 0)), "edge").reshape(-1, batch, space.size)
    parts = [evaluate(problem.objective, space, problem.data, part) for part in whole]
    values = np.concatenate(parts)[:count]
    best = every[np.argsort(values)[:_TRIED]]  # what is NaN comes last
    if problem.exact is not None:
        exact = evaluate(problem.objective, space, problem.exact, best, at_a_time=1)
        best = best[np.argsort(np.asarray(exact))]
    return space.design(best[0])


# How many optima are improved on the exact objective, and how: from the best of so many even
# samples within _NEAR, for its ripples are some hundredths of the cube wide, by a simplex that
# begins with sides of _SIDE and ends with steps and relative gains below the next two; with so many
# evaluations for each variable.
_IMPROVED, _TRIED, _NEAR = 3, 32, 0.1
_SIDE, _LEAST_STEP, _LEAST_GAIN, _MOST = 0.02, 1e-3, 1e-5, 50


def improved(
    problem: DesignProblem, starts: np.ndarray, statuses: list[Status]
) -> tuple[list[Found], int]:
    """The last start and the best three others improved, the rest as they are; evaluations.

    Without the gradient: an evaluation is costly, its gradient costs more to compile than all.
    """
    count, space = len(starts), problem.space

    def values(points: np.ndarray) -> np.ndarray:
        given = jnp.asarray(points, space.lower.dtype)
        given = problem.objective, space, problem.exact, given
        found = np.asarray(evaluate(*given, at_a_time=1), float)
        return np.where(np.isfinite(found), found, np.inf)

    known = values(starts)
    order = np.argsort(known[:-1], kind="stable")
    ended = [_found(space, starts[n], known[n], statuses[n]) for n in order[_IMPROVED:]]
    for start in (*order[:_IMPROVED], count - 1):
        result = _improve(values, np.asarray(starts[start], float))
        status: Status = "converged" if result.success else "iterations_exhausted"
        ended.append(_found(space, result.x, result.fun, status))
        count += result.nfev + _TRIED
    return [one for one in ended if np.isfinite(one.objective)], count


def _improve(
    values: Callable[[np.ndarray], np.ndarray], point: np.ndarray
) -> scipy.optimize.OptimizeResult:
    """The lowest point near one of the cube: the best of samples around it, then Nelder-Mead."""
    around = scipy.stats.qmc.Sobol(len(point), rng=0).random(_TRIED)
    near = np.concatenate([point[None], point + _NEAR * (2 * around[1:] - 1)]).clip(0.0, 1.0)
    level = values(near)
    start = near[np.argmin(level)]
    side = np.where(start > 0.5, -_SIDE, _SIDE)
    return scipy.optimize.minimize(
        lambda at: float(values(at[None])[0]),
        start,
        method="Nelder-Mead",
        bounds=[(0.0, 1.0)] * len(start),
        options={
            "initial_simplex": np.vstack([start, start + np.diag(side)]),
            "xatol": _LEAST_STEP,
            "fatol": _LEAST_GAIN * abs(np.min(level)),
            "maxfev": _MOST * len(start),
        },
    )


def descend(
    problem: DesignProblem,
    points: Float[Array, "start variable"],
    *,
    steps: int = 60,
    tolerance: float = 1e-6,
) -> Search:
    """Descents by L-BFGS-B (scipy) from points of the unit cube, one after the other.

    For costly objectives: all evaluations are by one program, and not inside a loop of XLA's, where
    a convolution on a CPU takes thirty times as long.
    """
    searched, ended = problem.searched, []
    for start in np.asarray(points, float):
        scale = np.asarray(_scale(_value_and_slope(searched, jnp.asarray(start, points.dtype))[0]))

        def cost(at: np.ndarray, scale: np.ndarray = scale) -> tuple[float, np.ndarray]:
            value, slope = _value_and_slope(searched, jnp.asarray(at, points.dtype))
            return float(value / scale), np.asarray(slope / scale, float)

        options = {"maxiter": steps, "ftol": tolerance}
        result = scipy.optimize.minimize(
            cost, start, jac=True, method="L-BFGS-B", bounds=[(0, 1)] * len(start), options=options
        )
        ends = result.x, result.fun * scale, result.nfev + 1, result.success
        ended.append(Descents(*map(jnp.asarray, ends)))
    every = jax.tree.map(lambda *parts: jnp.stack(parts), *ended)
    return search_of(problem.space, jnp.zeros(0, points.dtype), every, SEPARATION)


@eqx.filter_jit
def _value_and_slope(problem: DesignProblem, point: Float[Array, " variable"]):
    given = problem.objective, problem.space, problem.data
    return jax.value_and_grad(functools.partial(_value, *given))(point)


# Points of the unit cube that are evaluated at a time.
AT_A_TIME = 32


def evaluate(
    objective: Objective,
    space: DesignSpace,
    data: Any,
    points: Float[Array, "point variable"],
    *,
    at_a_time: int = AT_A_TIME,
) -> Float[Array, " point"]:
    """The objective at points of the unit cube, so many at a time.

    One at a time is for costly objectives: a single program serves any number of points.
    """
    if at_a_time > 1:
        # In whole batches: what is left over would be compiled as a program of its own.
        more = -len(points) % at_a_time
        whole = jnp.asarray(np.pad(np.asarray(points), ((0, more), (0, 0)), "edge"))
        return _evaluate(objective, space, data, whole, at_a_time)[: len(points)]
    # Parts of a JAX array would be programs of their own.
    each = [_value(objective, space, data, point) for point in np.asarray(points)]
    return jnp.asarray(np.stack(each))


@functools.partial(jax.jit, static_argnames="objective")
def _value(objective: Objective, space: DesignSpace, data: Any, point: Float[Array, " variable"]):
    return objective(space.design(point), data)


@functools.partial(jax.jit, static_argnames=("objective", "at_a_time"))
def _evaluate(objective, space, data, points, at_a_time: int) -> Float[Array, " point"]:
    at = functools.partial(_value, objective, space, data)
    return jax.lax.map(at, points, batch_size=at_a_time)


def even_samples(
    dimensions: int, count: int, key: PRNGKeyArray, dtype: DTypeLike
) -> Float[Array, "point variable"]:
    """Scrambled Sobol points of the unit cube."""
    seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
    power = max(0, (count - 1).bit_length())
    sampler = scipy.stats.qmc.Sobol(dimensions, scramble=True, rng=seed)
    return jnp.asarray(sampler.random_base2(power)[:count], dtype)


def best_apart(
    points: np.ndarray, values: np.ndarray, count: int, *, least: float = 0.0
) -> np.ndarray:
    """The lowest samples, each farther from those chosen before than half of the mean spacing.

    `least`: lower bound of that distance, in the cube.
    """
    spacing = max(least, 0.5 * len(points) ** (-1 / points.shape[1]))
    chosen: list[int] = []
    rest: list[int] = []
    for index in np.argsort(np.where(np.isfinite(values), values, np.inf), kind="stable"):
        near = np.any(np.max(np.abs(points[chosen] - points[index]), axis=-1) < spacing)
        (rest if near else chosen).append(int(index))
        if len(chosen) == count:
            break
    return np.asarray((chosen + rest)[:count])


def _scale(values: Float[Array, "*start"]) -> Float[Array, "*start"]:
    """Scale of each descent's tolerance: the objective at its start."""
    size = jnp.abs(values)
    return jnp.where(jnp.isfinite(size) & (size > 0), size, 1.0)


def on_cube(y: Float[Array, "..."]):
    """sin²: every number to [0, 1], smooth, and the faces are reached."""
    return jnp.sin(y) ** 2


@eqx.filter_jit
def _descend(problem: DesignProblem, points, scales, steps: int, tolerance) -> Descents:
    objective, space, data = problem.objective, problem.space, problem.data
    solver = optimistix.BFGS(rtol=tolerance, atol=tolerance)

    # A face is a stationary point of sin²: a start on it would stay.
    inner = jnp.clip(points, 1e-3, 1 - 1e-3)

    def one(point, scale):
        def loss(y, given):
            return objective(space.design(on_cube(y)), given) / scale

        solution = optimistix.minimise(
            loss, solver, jnp.arcsin(jnp.sqrt(point)), args=data, max_steps=steps, throw=False
        )
        ended = on_cube(solution.value)
        value = objective(space.design(ended), data)
        converged = solution.result == optimistix.RESULTS.successful
        return Descents(ended, value, solution.stats["num_steps"] + 1, converged)

    return jax.vmap(one)(inner, scales)


@eqx.filter_jit
def _descend_in_box(problem: DesignProblem, points, scales, steps: int, tolerance) -> Descents:
    objective, space, data = problem.objective, problem.space, problem.data
    from thincam_jax.design._jaxopt import descend_in_box  # jaxopt is slow to import

    def one(point, scale):
        def loss(p, given):
            return objective(space.design(p), given) / scale

        ended, value, count, converged = descend_in_box(loss, point, data, steps, tolerance)
        return Descents(ended, value * scale, count, converged)

    return jax.vmap(one)(points, scales)


def ranked(space: DesignSpace, ended: Descents, separation: float) -> tuple[Found, ...]:
    """The optima, best first, without those nearer than `separation` to a better one."""
    found = []
    for place, value, converged in zip(ended.points, ended.values, ended.converged, strict=True):
        if np.isfinite(value):
            status: Status = "converged" if converged else "iterations_exhausted"
            found.append(_found(space, place, value, status))
    return without_repeats(found, separation)


def _found(space: DesignSpace, place, value, status: Status) -> Found:
    point = jnp.asarray(place, space.lower.dtype)
    values, active = space.values(point), active_limits(space, point)
    named = dict(zip(space.labels, np.asarray(values).tolist(), strict=True))
    return Found(space.design(point), values, float(value), status, active, point, named)


def without_repeats(found: Iterable[Found], separation: float = SEPARATION) -> tuple[Found, ...]:
    """Best first, without those nearer than `separation` to a better one."""
    kept: list[Found] = []
    for one in sorted(found, key=lambda one: one.objective):
        if all(np.max(np.abs(one.point - other.point)) >= separation for other in kept):
            kept.append(one)
    return tuple(kept)
