"""Adam, by optax, on a loss that is drawn anew at every step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

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

    To be called inside jit. The rate falls to zero as a cosine; a step whose loss or slope is no
    number is skipped. `most`: the largest norm of a slope, to which longer ones are shortened.
    """
    method = optax.scale_by_adam()
    if most is not None:
        method = optax.chain(optax.clip_by_global_norm(most), method)
    place = jnp.linspace(0.0, 1.0, steps, dtype=rate.dtype)
    rates = rate * 0.5 * (1 + jnp.cos(jnp.pi * place))

    def step(carry, drawn):
        parameters, state, skipped = carry
        step_key, step_rate = drawn
        (value, kept), slope = jax.value_and_grad(loss, has_aux=True)(parameters, step_key)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((value, slope))]
        usable = jnp.all(jnp.stack(finite))
        # optax multiplies floats by integers, which strict promotion forbids.
        with jax.numpy_dtype_promotion("standard"):
            updates, after = method.update(slope, state)
        moved = jax.tree.map(lambda p, u: p - step_rate * u, parameters, updates)
        parameters, state = jax.tree.map(
            lambda new, old: jnp.where(usable, new, old), (moved, after), (parameters, state)
        )
        return (parameters, state, skipped + (~usable).astype(int)), kept

    first = (start, method.init(start), jnp.asarray(0))
    (end, _, skipped), kept = jax.lax.scan(step, first, (jax.random.split(key, steps), rates))
    return end, kept, skipped
