"""Adam, by optax, on a loss that is drawn anew at every step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

# (parameters, key) → the loss, and what is kept of the step.
DrawnLoss = Callable[[Any, Any], tuple[Any, Any]]


def adam(
    loss: DrawnLoss,
    start: Any,
    key: PRNGKeyArray,
    rate: Float[Array, ""],
    steps: int,
    *,
    most: float | None = None,
):
    """The parameters after so many steps, what was kept of each, and how many changed nothing.

    To be called inside jit. The rate falls to zero as a cosine; a step whose loss or slope is NaN
    or infinite is skipped. `most`: the largest norm of a slope, to which longer ones are shortened.
    """
    method = adam_method(most)
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
    """Adam's direction; `most` as of `adam`."""
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
