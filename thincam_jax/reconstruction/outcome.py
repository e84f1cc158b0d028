"""The `Outcome` of a method that runs to its end in one piece, without looking up."""

import math
import time
from collections.abc import Callable

import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from thincam_jax.reconstruction.drive import Outcome, Progress, Status


def concluded(
    start: Float[Array, "*batch channel plane y x"],
    image: Float[Array, "*batch channel plane y x"],
    objective: Callable[[Array], Array],
    *,
    converged: bool,
    iterations: int,
    began: float,
) -> Outcome:
    """What `drive` would say: the objective before and after, the start where the end is no number.

    - `began`: `time.perf_counter()` at the start.
    """
    before, after = (_progress(n, objective(x)) for n, x in ((0, start), (iterations, image)))
    # Of captures that hold no number a linear solver may return a clean zero.
    finite = bool(jnp.isfinite(image).all()) and math.isfinite(after.objective)
    status: Status = "converged" if converged else "iterations_exhausted"
    return Outcome(
        image if finite else start,
        status if finite else "non_finite",
        (before, after),
        iterations,
        time.perf_counter() - began,
    )


def concluded_by(
    solution: optimistix.Solution,
    start: Float[Array, "*batch channel plane y x"],
    image: Float[Array, "*batch channel plane y x"],
    objective: Callable[[Array], Array],
    *,
    began: float,
) -> Outcome:
    """The same of a solution of optimistix, which knows how it ended."""
    return concluded(
        start,
        image,
        objective,
        converged=bool(solution.result == optimistix.RESULTS.successful),
        iterations=int(solution.stats["num_steps"]),
        began=began,
    )


def _progress(iteration: int, value: Float[Array, "..."]) -> Progress:
    return Progress(iteration, float(jnp.sum(value)), float("nan"), float("nan"))
