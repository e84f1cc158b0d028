"""Time of a compiled function."""

import statistics
import time
from typing import Any, NamedTuple

import jax
import numpy as np

# A median of at most so many calls, and no further one once they took so many seconds.
_MOST_CALLS, _SECONDS = 15, 0.5


class Timing(NamedTuple):
    """How long one call takes, and what it gives.

    - `result`: of the call.
    - `seconds`: median over `calls` calls after one that does not count, waited for.
    - `compile_seconds`: tracing and compilation, once, s.
    """

    result: np.ndarray
    seconds: float
    compile_seconds: float
    calls: int


def measure(function, *arguments: Any) -> Timing:
    """Compile a function of arrays and time it."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    result = np.asarray(jax.block_until_ready(compiled(*arguments)))
    taken: list[float] = []
    while len(taken) < _MOST_CALLS and sum(taken) < _SECONDS:
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        taken.append(time.perf_counter() - start)
    return Timing(result, statistics.median(taken), compile_seconds, len(taken))
