"""Stochastic search: Adam, by optax, on an objective that is drawn anew at every step."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from thincam_jax._core.module import Module
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.design import Design
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.search import on_cube


class Descent(Module):
    """End of a stochastic descent.

    - `design`, `values`, `point`: design at the mean of the second half of the steps, its free
      numbers, and that point of the cube.
    - `history`: the objective, as drawn, at every step.
    - `skipped`: steps whose objective or gradient was not finite; they changed nothing.
    """

    design: Design
    values: Float[Array, " variable"]
    point: Float[Array, " variable"]
    history: Float[Array, " step"]
    skipped: int


def stochastic_descent(
    problem: DesignProblem,
    point: Float[Array, " variable"],
    *,
    key: Key,
    steps: int = 100,
    rate: float = 0.03,
) -> Descent:
    """Adam from a point of the unit cube, with the rate falling to zero as a cosine.

    - `problem`: its objective is (design, data, key) → a number, at module level.
    - `rate`: step of the angle that sin² maps onto the cube; the cube's side is π/2 of it.
    """
    key = random_key(key)
    if steps < 2 or not rate > 0:
        raise ValueError(
            f"steps = {steps}, rate = {rate}: give at least 2 steps and a rate above 0"
        )
    inner, space = jnp.clip(point, 1e-3, 1 - 1e-3), problem.space
    mean, history, skipped = _descend(problem, inner, key, steps, jnp.asarray(rate, inner.dtype))
    return Descent(space.design(mean), space.values(mean), mean, history, int(skipped))


@eqx.filter_jit
def _descend(problem, point, key, steps: int, rate):
    def loss(y, step_key):
        value = problem.objective(problem.space.design(on_cube(y)), problem.data, step_key)
        return value, (y, value)

    start = jnp.arcsin(jnp.sqrt(point))
    end, (path, history), skipped = adam(loss, start, key, rate, steps)
    late = jnp.concatenate([path[steps // 2 + 1 :], end[None]])
    return jnp.mean(on_cube(late), axis=0), history, skipped


# (parameters, key) → the loss, and what is kept of the step.
DrawnLoss = Callable[[Any, Any], tuple[Any, Any]]


def adam(loss: DrawnLoss, start: Any, key: PRNGKeyArray, rate: Float[Array, ""], steps: int):
    """The parameters after so many steps, what was kept of each, and how many changed nothing.

    To be called inside jit. The rate falls to zero as a cosine; a step whose loss or slope is NaN
    or infinite is skipped.
    """
    method = adam_method()
    place = jnp.linspace(0.0, 1.0, steps, dtype=rate.dtype)
    rates = rate * 0.5 * (1 + jnp.cos(jnp.pi * place))

    def step(carry, drawn):
        parameters, state, skipped = carry
        step_key, step_rate = drawn
        parameters, state, usable, (_, kept) = adam_step(
            lambda p: loss(p, step_key), parameters, state, step_rate, method
        )
        return (parameters, state, skipped + (~usable).astype(int)), kept

    first = (start, method.init(start), jnp.asarray(0))
    (end, _, skipped), kept = jax.lax.scan(step, first, (jax.random.split(key, steps), rates))
    return end, kept, skipped


def adam_method(most: float | None = None) -> optax.GradientTransformation:
    """Adam's direction; `most`: the largest norm of a slope, to which longer ones are shortened."""
    method = optax.scale_by_adam()
    if most is None:
        return method
    return optax.chain(optax.clip_by_global_norm(most), method)


def adam_step(
    loss: Callable[[Any], tuple[Any, Any]],
    parameters: Any,
    state: Any,
    rate: Float[Array, ""],
    method: optax.GradientTransformation,
) -> tuple[Any, Any, Bool[Array, ""], tuple[Any, Any]]:
    """Parameters and state after a step, whether it was one, and what `loss` gave before it.

    Where the loss or its slope is NaN or infinite, nothing changes.
    """
    (value, kept), slope = jax.value_and_grad(loss, has_aux=True)(parameters)
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((value, slope))]
    usable = jnp.all(jnp.stack(finite))
    # optax multiplies floats by integers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        updates, after = method.update(slope, state)
    moved = jax.tree.map(lambda p, u: p - rate.astype(p.dtype) * u, parameters, updates)
    parameters, state = jax.tree.map(
        lambda new, old: jnp.where(usable, new, old), (moved, after), (parameters, state)
    )
    return parameters, state, usable, (value, kept)
