"""Time of a compiled function."""

import statistics
import time
from typing import Any, NamedTuple

import jax
import numpy as np

# A median of at most so many calls, and no further one once they took so many seconds.
_MOST_CALLS, _SECONDS = 15, 0.5
# A call that takes longer than this needs no warming up: it is itself the measurement.
_LONG = 1.0


class Timing(NamedTuple):
    """How long one call takes, and what it gives.

    - `result`: of the call.
    - `seconds`: median over `calls` calls after one that does not count, each waited for; of a
      call that takes more than a second, that of the first.
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
    result, first = _timed(compiled, arguments)
    taken = [first] if first > _LONG else []
    while len(taken) < _MOST_CALLS and sum(taken) < _SECONDS:
        taken.append(_timed(compiled, arguments)[1])
    return Timing(np.asarray(result), statistics.median(taken), compile_seconds, len(taken))


def _timed(compiled, arguments) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, time.perf_counter() - start
