"""Tools shared by the tests: data, trace counting, gradients by differences, relative errors."""

import contextlib
import functools
import resource
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
# To the compiler: as optimised as in the package's use, where sums round otherwise than without.
AS_IN_USE = {"xla_backend_optimization_level": 3}


def shared_data(name: str) -> Path:
    """The path of a data set that lies beside the checkout, `../shared/data/<name>`.

    The data are too large for the repository: where they are absent the test is skipped.
    """
    path = ROOT.parent / "shared" / "data" / name
    if not path.exists():
        pytest.skip(f"needs the data set {name} at ../shared/data/{name}, beside the checkout")
    return path


@contextlib.contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file takes more than so many bytes: writing ends as on a full disk.

    Not Python's compiled modules: it would leave them cut off for the next process.
    """
    before, writes = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = writes


def point_psf(camera: Any, **how: Any) -> jax.Array:
    """`tc.psf` at the pixels' centres, not averaged over them."""
    import thincam_jax as tc

    return tc.psf(camera, pixel_integration=False, **how)


def point_otf(camera: Any, **how: Any) -> jax.Array:
    """`tc.otf` of the PSF at the pixels' centres."""
    import thincam_jax as tc

    return tc.otf(camera, pixel_integration=False, **how)


def read_fiducial(pixels: Any, bit_depth: int) -> Any:
    """The fiducial that a virtual rig writes into the corner of a frame."""
    from thincam_jax.hardware.virtual.rig import FIDUCIAL_SHAPE, Fiducial

    rows, columns = FIDUCIAL_SHAPE
    bits = pixels[:rows, :columns] > 2 ** (bit_depth - 2)
    words = np.packbits(bits).view(">u4").astype(np.int64)
    return Fiducial(int(words[0]), int(words[1]) - 2**31, int(words[2]))


def recipe(name: str) -> str:
    """The code of "## Adding …" in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8").split(f"## Adding {name}\n")[1]
    return text.split("```python\n")[1].split("```")[0]


def quick(values: Iterable, *places: int) -> list:
    """Parameters of a test: those at `places` in every run, the others in the thorough one."""
    return [
        value
        if place in places
        else pytest.param(
            *(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.thorough
        )
        for place, value in enumerate(values)
    ]


def rows(table: str) -> list[tuple[str, ...]]:
    """Rows of a test's table: a line each, with " | " between the columns."""
    return [tuple(cell.strip() for cell in row.split(" | ")) for row in table.strip().split("\n")]


def in_full(small: Any, large: Any) -> list:
    """Sizes of a test: that of the thorough run, and that whose figures the docs quote."""
    return [
        pytest.param(*(size if isinstance(size, tuple) else (size,)), marks=mark)
        for size, mark in ((small, pytest.mark.thorough), (large, pytest.mark.full_size))
    ]


def count_traces(function: Callable) -> Callable:
    """Wrap a function so that `wrapped.traces` says how often its Python body ran.

    Wrap first, compile second: under jit the body runs once a trace, so the count is the number of
    compilations that the calls caused::

        counted = count_traces(lambda beta: psf_of(beta))
        compiled = jax.jit(counted)
        compiled(jnp.asarray(25.0)), compiled(jnp.asarray(26.0))
        assert counted.traces == 1

    Wrapping a function that is already compiled counts its calls, not its traces.
    """

    @functools.wraps(function)
    def counted(*args, **kwargs):
        counted.traces += 1
        return function(*args, **kwargs)

    counted.traces = 0
    return counted


def compilations(run: Callable[[], Any]) -> int:
    """How many programs JAX compiles, or loads, while `run` runs."""
    heard = _heard()
    before = len(heard)
    run()
    return len(heard) - before


@functools.cache
def _heard() -> list[str]:
    """One entry for each program from the first call on, of the whole process."""
    heard: list[str] = []

    def listen(event: str, seconds: float, **_):
        if "backend_compile" in event:
            heard.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.jit(lambda x: jnp.sin(x) * 1.2345)(jnp.arange(3.0))
    assert heard  # it hears
    return heard


def finite_difference(function: Callable, x: Any, direction: Any, step: float) -> Any:
    """The derivative of `function` at `x` along `direction`, by differences of fourth order.

    `x` is a float64 array or a pytree of them, `direction` has its structure; the result has that
    of `function(x)`. Two central differences D are extrapolated (Richardson):

        (4 D(step/2) - D(step)) / 3  =  f' - step^4 f^(5) / 480 + O(step^6)

    **Choosing the step.** It is counted in multiples of `direction`. Optical fields oscillate: let
    `rate` be the largest change of phase per unit of step, in radians (for the curvature β of a
    zone plate it is r², 16 rad per rad/mm² at the corner of a plate 5.6 mm wide), and `phase` the
    largest phase itself, whose rounding error is phase·eps. The relative error is then about

        (rate·step)^4 / 480  +  2 max(1, phase)·eps / (rate·step)

    smallest at rate·step = (240 max(1, phase)·eps)^(1/5). So take step = 0.003 / rate where the
    phases are small (error about 1e-13) and 0.015 / rate at phases of 1e4 rad (about 3e-10). A
    step with rate·step near 1 or above measures the fringes, not the slope. What oscillates slowly,
    a loss for one, stands larger steps. Check the step by halving it: the result must not move.
    """
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves((x, direction))]
    if any(leaf.dtype not in (jnp.float64, jnp.complex128) for leaf in leaves):
        found = ", ".join(sorted({str(leaf.dtype) for leaf in leaves}))
        raise ValueError(f"differences need float64 in x and in direction, not {found}")

    def moved(a: Any, v: Any, offset: float) -> jax.Array:
        # By NumPy: JAX would compile the sum for every shape.
        value = np.asarray(a) + offset * np.asarray(v)
        # As weakly typed as `a`: a function that was compiled for it would be traced again.
        return jax.device_put(value.item() if getattr(a, "weak_type", False) else np.asarray(value))

    def at(offset: float) -> Any:
        return jax.device_get(
            function(jax.tree.map(lambda a, v: moved(a, v, offset), x, direction))
        )

    def central(h: float) -> Any:
        return jax.tree.map(lambda high, low: (high - low) / (2.0 * h), at(h), at(-h))

    half, full = central(step / 2), central(step)
    return jax.tree.map(lambda fine, coarse: (4.0 * fine - coarse) / 3.0, half, full)


def value_and_slope(function: Callable, argnums: Any = 0) -> tuple[Callable, Callable]:
    """`function` and its gradient, of one compiled program: half the time of one for each."""
    both = jax.jit(jax.value_and_grad(function, argnums))
    return (lambda *point: both(*point)[0]), (lambda *point: both(*point)[1])


def relative_l2(value: Any, reference: Any) -> float:
    """‖value − reference‖₂ / ‖reference‖₂ over all elements; shapes must agree exactly."""
    value, reference = np.asarray(value), np.asarray(reference)
    if value.shape != reference.shape:
        raise ValueError(f"value has shape {value.shape}, reference has {reference.shape}")
    scale = np.linalg.norm(reference.ravel())
    if not scale > 0.0:
        raise ValueError("a reference that is zero or NaN has no relative error")
    return float(np.linalg.norm((value - reference).ravel()) / scale)
