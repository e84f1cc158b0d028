"""Search with an objective that is drawn anew at every step: Adam, by optax."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.module import Module
from thincam_jax.design.adam import adam
from thincam_jax.design.design import Design
from thincam_jax.design.search import on_cube
from thincam_jax.design.space import DesignSpace

StochasticObjective = Callable[[Design, Any, PRNGKeyArray], Float[Array, ""]]


class Descent(Module):
    """Where a stochastic descent ended.

    - `design`, `values`, `point`: of the mean of the second half of the steps, in the cube.
    - `history`: the objective, as drawn, at every step.
    - `skipped`: steps whose objective or gradient was not finite; they changed nothing.
    """

    design: Design
    values: Float[Array, " variable"]
    point: Float[Array, " variable"]
    history: Float[Array, " step"]
    skipped: int


def stochastic_descent(
    objective: StochasticObjective,
    space: DesignSpace,
    data: Any,
    point: Float[Array, " variable"],
    *,
    key: PRNGKeyArray,
    steps: int = 100,
    rate: float = 0.03,
) -> Descent:
    """Adam from a point of the unit cube, with the rate falling to zero as a cosine.

    `objective`: (design, data, key) → a number, at module level. `rate`: of the angle that sin²
    maps onto the cube; the cube's side is π/2 of it.
    """
    if steps < 2 or not rate > 0:
        raise ValueError(
            f"steps = {steps}, rate = {rate}: give at least 2 steps and a rate above 0"
        )
    inner = jnp.clip(point, 1e-3, 1 - 1e-3)
    mean, history, skipped = _descend(objective, space, data, inner, key, steps, rate)
    return Descent(space.design(mean), space.values(mean), mean, history, int(skipped))


@functools.partial(jax.jit, static_argnames=("objective", "steps"))
def _descend(objective, space, data, point, key, steps: int, rate):
    def loss(y, step_key):
        value = objective(space.design(on_cube(y)), data, step_key)
        return value, (y, value)

    start = jnp.arcsin(jnp.sqrt(point))
    end, (path, history), skipped = adam(loss, start, key, jnp.asarray(rate, point.dtype), steps)
    late = jnp.concatenate([path[steps // 2 + 1 :], end[None]])
    return jnp.mean(on_cube(late), axis=0), history, skipped
