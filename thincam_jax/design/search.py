r"""The best design by gradient: many starts at a time, in one compiled program.

Objectives of a design have many local optima: fringes of several captures beat against each other.
So the cube is first sampled evenly, and descents begin at the best of the samples.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax.design.design import Design
from thincam_jax.design.space import DesignSpace, active_limits

Objective = Callable[[Design, Any], Float[Array, ""]]
Solver = Literal["bfgs", "lbfgsb"]
# Optima closer than this in the unit cube are one.
APART = 0.02

Status = Literal["converged", "iterations_exhausted", "non_finite"]


class Descents(NamedTuple):
    """Where each start ended, and how many evaluations of the objective it took."""

    points: Float[Array, "start variable"]
    values: Float[Array, " start"]
    evaluations: Int[Array, " start"]
    converged: Bool[Array, " start"]


class Found(NamedTuple):
    """A local optimum.

    - `design`; `values`: its free numbers, in the order of the space's variables.
    - `objective`: its value there.
    - `status`: of the descent that ended there.
    - `active`: the limits it lies against, in words.
    - `point`: in the unit cube.
    """

    design: Design
    values: Float[Array, " variable"]
    objective: float
    status: Status
    active: tuple[str, ...]
    point: Float[Array, " variable"]


class Search(NamedTuple):
    """The optima found, best first, without those that repeat a better one.

    - `evaluations`: of the objective, with or without its gradient: of all samples and of each
      descent up to its own end.
    - `failed`: how many samples and descents met an objective that is not finite.
    """

    found: tuple[Found, ...]
    evaluations: int
    failed: int


def find_designs(
    objective: Objective,
    space: DesignSpace,
    data: Any,
    *,
    key: PRNGKeyArray,
    starts: int = 16,
    samples: int = 512,
    steps: int = 60,
    solver: Solver = "bfgs",
    tolerance: float = 1e-6,
    apart: float = APART,
) -> Search:
    """The designs of a space where an objective is smallest.

    **Arguments**

    - `objective`: (design, data) → a number, at module level, so that it is compiled once.
    - `starts`: descents; `samples`: of the even (scrambled Sobol) sampling before, from which
      those start that are lowest among their neighbours; at least `starts`.
    - `steps`: at most, of each descent.
    - `solver`: "bfgs" (optimistix), under the smooth map sin² onto the cube, or "lbfgsb" (jaxopt)
      within its faces.
    - `tolerance`: relative change of the objective and absolute change in the cube at the end.
    - `apart`: optima closer than this in the cube are one.

    **Errors**: ValueError for numbers of starts, samples or steps below 1.
    """
    checks.at_least_one({"starts": starts, "samples": samples, "steps": steps})
    checks.choice("solver", solver, ("bfgs", "lbfgsb"))
    points = even_samples(space.size, max(samples, starts), key, space.lower.dtype)
    values = evaluate(objective, space, data, points)
    chosen = best_apart(np.asarray(points), np.asarray(values), starts)
    descend = _descend if solver == "bfgs" else _descend_in_box
    ended = descend(
        objective, space, data, points[chosen], _scale(values[chosen]), steps, tolerance
    )
    ended = jax.device_get(ended)
    failed = sum(int(np.sum(~np.isfinite(v))) for v in (np.asarray(values), ended.values))
    used = len(points) + int(np.sum(ended.evaluations))
    return Search(ranked(space, ended, apart), used, failed)


def descend(
    objective: Objective,
    space: DesignSpace,
    data: Any,
    points: Float[Array, "start variable"],
    *,
    steps: int = 60,
    tolerance: float = 1e-6,
    apart: float = APART,
    told: Callable[[int], object] | None = None,
) -> Search:
    """Descents from given points of the unit cube, one after the other: for costly objectives.

    By BFGS; arguments and result as of `search`. `told` is called with the place of each point as
    its descent begins.
    """
    ended = []
    for place, point in enumerate(points):
        if told is not None:
            told(place)
        value = evaluate(objective, space, data, point[None])
        ended.append(_descend(objective, space, data, point[None], _scale(value), steps, tolerance))
    stacked = jax.device_get(jax.tree.map(lambda *parts: jnp.concatenate(parts), *ended))
    failed = int(np.sum(~np.isfinite(stacked.values)))
    return Search(ranked(space, stacked, apart), int(np.sum(stacked.evaluations)), failed)


# Points of the unit cube that are evaluated at a time.
_AT_A_TIME = 32


@functools.partial(jax.jit, static_argnames=("objective", "at_a_time"))
def evaluate(
    objective: Objective,
    space: DesignSpace,
    data: Any,
    points: Float[Array, "point variable"],
    *,
    at_a_time: int = _AT_A_TIME,
) -> Float[Array, " point"]:
    """The objective at points of the unit cube, so many at a time."""

    def at(point):
        return objective(space.design(point), data)

    return jax.lax.map(at, points, batch_size=at_a_time)


def landscape(
    objective: Objective,
    space: DesignSpace,
    data: Any,
    count: int,
    *,
    at_a_time: int = _AT_A_TIME,
) -> tuple[Float[Array, "point variable"], Float[Array, " point"]]:
    """The objective on an even grid over the cube, `count` points along each variable.

    Feasible for two or three variables; the grid's best is what a search can be checked against.
    """
    if count < 2 or count**space.size > 10_000_000:
        raise ValueError(
            f"a grid of {count}^{space.size} points; give 2 or more a side and at most 10 million"
        )
    axis = jnp.linspace(0.0, 1.0, count, dtype=space.lower.dtype)
    mesh = jnp.meshgrid(*[axis] * space.size, indexing="ij")
    points = jnp.stack([m.ravel() for m in mesh], axis=-1)
    return points, evaluate(objective, space, data, points, at_a_time=at_a_time)


def even_samples(dimensions: int, count: int, key, dtype) -> Float[Array, "point variable"]:
    """Scrambled Sobol points of the unit cube."""
    seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
    power = max(0, (count - 1).bit_length())
    sampler = scipy.stats.qmc.Sobol(dimensions, scramble=True, rng=seed)
    return jnp.asarray(sampler.random_base2(power)[:count], dtype)


def best_apart(
    points: np.ndarray, values: np.ndarray, count: int, *, least: float = 0.0
) -> np.ndarray:
    """The lowest samples, each farther from those chosen before than half of the mean spacing.

    `least`: what that is at least, in the cube.
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


def _scale(values: Float[Array, " start"]) -> Float[Array, " start"]:
    """What each descent's tolerance is relative to: the objective at its start."""
    size = jnp.abs(values)
    return jnp.where(jnp.isfinite(size) & (size > 0), size, 1.0)


def on_cube(y):
    """sin²: every number to [0, 1], smooth, and the faces are reached."""
    return jnp.sin(y) ** 2


@functools.partial(jax.jit, static_argnames=("objective", "steps"))
def _descend(objective, space, data, points, scales, steps: int, tolerance) -> Descents:
    solver = optimistix.BFGS(rtol=tolerance, atol=tolerance)

    # A face is a stationary point of sin²: a start on it would stay.
    inner = jnp.clip(points, 1e-3, 1 - 1e-3)

    def one(point, scale):
        def loss(y, given):
            return objective(space.design(on_cube(y)), given) / scale

        solution = optimistix.minimise(
            loss,
            solver,
            jnp.arcsin(jnp.sqrt(point)),
            args=data,
            max_steps=steps,
            throw=False,
        )
        ended = on_cube(solution.value)
        value = objective(space.design(ended), data)
        converged = solution.result == optimistix.RESULTS.successful
        return Descents(ended, value, solution.stats["num_steps"] + 1, converged)

    return jax.vmap(one)(inner, scales)


@functools.partial(jax.jit, static_argnames=("objective", "steps"))
def _descend_in_box(objective, space, data, points, scales, steps: int, tolerance) -> Descents:
    from thincam_jax.design._jaxopt import descend_in_box  # jaxopt is slow to import

    def one(point, scale):
        def loss(p, given):
            return objective(space.design(p), given) / scale

        ended, value, count, converged = descend_in_box(loss, point, data, steps, tolerance)
        return Descents(ended, value * scale, count, converged)

    return jax.vmap(one)(points, scales)


def ranked(space: DesignSpace, ended: Descents, apart: float) -> tuple[Found, ...]:
    """The optima, best first, without those nearer than `apart` to a better one."""
    found: list[Found] = []
    order = jnp.argsort(jnp.where(jnp.isfinite(ended.values), ended.values, jnp.inf))
    for index in order:
        point, value = jnp.asarray(ended.points[index]), float(ended.values[index])
        if not jnp.isfinite(value):
            break
        if any(float(jnp.max(jnp.abs(point - f.point))) < apart for f in found):
            continue
        status: Status = "converged" if bool(ended.converged[index]) else "iterations_exhausted"
        found.append(
            Found(
                space.design(point),
                space.values(point),
                value,
                status,
                active_limits(space, point),
                point,
            )
        )
    return tuple(found)
