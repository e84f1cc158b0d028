"""Bounded quasi-Newton by jaxopt."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxopt
from jaxtyping import Array, Bool, Float, Int

from thincam_jax._core.checks import Number

# Of a line search, each an evaluation for all starts that run together; and searches in vain
# before a descent ends.
_TRIALS, _IDLE = 8, 3


def descend_in_box(
    value: Callable[[Array, Any], Float[Array, ""]],
    point: Float[Array, " variable"],
    data: Any,
    steps: int,
    tolerance: Number,
) -> tuple[Float[Array, " variable"], Float[Array, ""], Int[Array, ""], Bool[Array, ""]]:
    """L-BFGS-B within the unit cube of a value of about 1.

    Returns the end, the value there, the number of evaluations, and whether it converged. It ends
    where the projected gradient is below the square root of `tolerance` (there the value changes by
    about `tolerance`), or where several line searches in a row gain less than a hundredth of it.
    """
    # Sufficient decrease only (c2 takes any slope): halving a step meets no other condition.
    search = jaxopt.BacktrackingLineSearch(
        fun=jax.value_and_grad(value),
        value_and_grad=True,
        maxiter=_TRIALS,
        decrease_factor=0.4,
        condition="strong-wolfe",
        c2=1e30,
        tol=0.0,
    )
    solver = jaxopt.LBFGSB(fun=value, linesearch=search, implicit_diff=False, history_size=6)  # pyright: ignore
    bounds = (jnp.zeros_like(point), jnp.ones_like(point))
    enough = jnp.sqrt(jnp.asarray(tolerance, point.dtype))

    def more(carry):
        _, state, idle = carry
        return (state.iter_num < steps) & (state.error > enough) & (idle < _IDLE)

    def step(carry):
        p, state, idle = carry
        moved, after = solver.update(p, state, bounds, data)
        gain = state.value - after.value
        # A search that failed took a longer step than it should: back, and on from a shorter one.
        back = after._replace(value=state.value, grad=state.grad, error=state.error)
        moved, after = jax.tree.map(
            lambda new, old: jnp.where(gain >= 0, new, old), (moved, after), (p, back)
        )
        little = ~(gain > 0.01 * tolerance * jnp.abs(state.value))
        return jnp.clip(moved, 0.0, 1.0), after, jnp.where(little, idle + 1, 0)

    first = solver.init_state(point, bounds, data)
    first = jax.tree.map(jnp.asarray, first)
    ended, state, idle = jax.lax.while_loop(more, step, (point, first, jnp.asarray(0)))
    return ended, state.value, state.num_fun_eval, (state.error <= enough) | (idle >= _IDLE)
