"""Public calls with one or two arguments that nobody should give, as users make them.

Types are not checked here as they are in the other tests: a user has no such checks. A call may
end in an error that the package raises itself, or in finite numbers, or in a status other than
success. `python tests/hostile_calls.py COUNT SEED` tries so many and prints the smallest call that
does none of these.
"""

import linecache
import math
import sys
import traceback
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from hostile_images import IMAGES
from hostile_rooms import ROOMS
from hostile_table import OPTICS, Call
from hypothesis import HealthCheck, given, seed, settings, strategies
from hypothesis.extra.numpy import array_shapes, arrays

import thincam_jax as tc
from thincam_jax.hardware import HardwareError

PACKAGE = str(Path(tc.__file__).parent)


NUMBERS = (0, -1, 0.5, 1e-45, 1e-300, 1e-12, 1e12, 1e30, 1e38, 1e300, math.nan, math.inf, -math.inf)
SINGLES = (1e-38, 1e30, 3e38)
OBJECTS = (None, "a", "5", True, 1j, (), (3, 2), (1e30, 1e30), {}, object(), [[1, 2], [3]])
ARRAYS = (
    *(np.ones(3), np.ones((3, 9, 12)), np.ones((1, 0, 5)), np.zeros((9, 12))),
    *(np.full((9, 12), number) for number in (math.nan, 1e30, 1 + 1j)),
    np.full((9, 12), 1e-30, np.float32),
    *(np.ones((9, 12), bool), np.ones((12, 9), np.uint8), np.array(["a", "b"])),
)
VALUES = strategies.one_of(
    strategies.sampled_from([*NUMBERS, *map(np.float32, SINGLES), np.float64(2.0), *OBJECTS]),
    strategies.sampled_from(ARRAYS),
    strategies.floats(width=32),
    arrays(strategies.sampled_from(["f4", "f8", "i4"]), array_shapes(max_dims=3, max_side=4)),
)


@strategies.composite
def hostile(draw: strategies.DrawFn) -> Call:
    """One of the calls with one or two arguments replaced."""
    made = draw(strategies.sampled_from((*OPTICS, *ROOMS, *IMAGES)))
    for _ in range(draw(strategies.integers(1, 2))):
        made = made.replaced(draw(strategies.sampled_from(list(made.paths()))), draw(VALUES))
    return made


def fault(made: Call) -> str | None:
    """What is wrong with the call's end, or None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return "NaN without a status" if _has_nan(made()) else None
    except Exception as error:  # any may come, and is the fault that is looked for
        return _foreign(error)


def _foreign(error: Exception) -> str | None:
    """None for an error that the package raises in a line of its own."""
    frames = traceback.extract_tb(error.__traceback__)
    source = linecache.getline(frames[-1].filename, frames[-1].lineno or 0).strip()
    own = frames[-1].filename.startswith(PACKAGE) and source.startswith("raise ")
    if isinstance(error, eqx.EquinoxRuntimeError | OSError):  # of a file, with its name
        return None
    kinds = ValueError | TypeError | MemoryError | HardwareError
    if own and isinstance(error, kinds) and "\n" not in str(error):
        return None
    inside = [frame for frame in frames if frame.filename.startswith(PACKAGE)]
    places = ", ".join(f"{Path(f.filename).name}:{f.lineno}" for f in inside[-3:])
    return f"{type(error).__name__} at {places}: {' '.join(str(error).split())[:100]}"


def _has_nan(result: Any) -> bool:
    """Whether the result holds NaN without saying so."""
    if getattr(result, "status", "ok") != "ok":
        return False
    if hasattr(result, "predicted_error"):
        result = result.predicted_error  # other estimates are NaN where there are none
    leaves = jax.tree.leaves(result)
    numbers = [np.asarray(one) for one in leaves if isinstance(one, np.ndarray | jax.Array | float)]
    return any(one.dtype.kind in "fc" and np.isnan(one).any() for one in numbers)


def main(count: int, number: int) -> None:
    @seed(number)
    @settings(max_examples=count, deadline=None, database=None, suppress_health_check=HealthCheck)
    @given(hostile())
    def search(made: Call) -> None:
        told = fault(made)
        assert told is None, told

    search()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
