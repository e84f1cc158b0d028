"""Time of an objective with its gradient, and of many starts at a time.

The thesis' four captures, judged by the Bayes error of its two pairs. `Quadrant` of 512² samples
holds what an image of 1024² pixels holds, for the response is even along both axes.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.design import PowerLaw, Setup, shots
from thincam_jax.design.objectives import bayes_error, channels
from thincam_jax.design.setup import Polar, Quadrant
from thincam_jax.reconstruction import phase_pairs

HIGHEST = 290.0
FREQUENCIES = {
    "quadrant 512": lambda highest: Quadrant(highest, 512),
    "polar 2048x4": lambda highest: Polar(highest, 2048, 4),
    "polar 512x3": lambda highest: Polar(highest, 512, 3),
}


def error(design, data):
    judged, frequencies = data
    return bayes_error(channels(design, judged, jnp.asarray(phase_pairs(2)), frequencies))


def problem(kind, dtype):
    design = shots([25.0, 21.0], 6.5, (0.0, 1.5 * np.pi), wavelength=500e-6, width=5.632)
    judged = Setup(
        pitch=5.5e-3,
        sensor_width=5.632,
        object_distance=250.0,
        object_width=150.0,
        prior=PowerLaw(2.8),
    )
    design, judged = jax.tree.map(lambda leaf: leaf.astype(dtype), (design, judged))
    return design, (judged, FREQUENCIES[kind](jnp.asarray(HIGHEST, dtype)))


def measure(benchmark, function, arguments, rounds):
    """Compile apart, warm up, and time until the result is there."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    benchmark.extra_info["compile_s"] = round(time.perf_counter() - start, 2)
    memory = compiled.memory_analysis()
    if memory is not None:
        benchmark.extra_info["peak_mib"] = round(memory.temp_size_in_bytes / 2**20, 1)
    value, _ = jax.block_until_ready(compiled(*arguments))
    assert np.all(np.isfinite(value))
    benchmark.pedantic(
        lambda: jax.block_until_ready(compiled(*arguments)),
        rounds=rounds,
        warmup_rounds=2,
        iterations=1,
    )
    return value


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("kind", ["quadrant 512", "polar 2048x4"])
@pytest.mark.benchmark(group="value and gradient")
def test_value_and_gradient(benchmark, kind, dtype):
    value = measure(benchmark, jax.value_and_grad(error), problem(kind, dtype), 20)
    assert value.dtype == jnp.dtype(dtype)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.benchmark(group="256 starts")
def test_many_starts(benchmark, dtype):
    """One call for 256 designs; `peak_mib` is what the program holds beside its arguments."""
    design, data = problem("polar 512x3", dtype)
    factors = jnp.linspace(0.7, 1.3, 256, dtype=dtype)
    designs = jax.vmap(lambda f: jax.tree.map(lambda leaf: leaf * f, design))(factors)
    slopes = jax.vmap(jax.value_and_grad(error), in_axes=(0, None))
    value = measure(benchmark, slopes, (designs, data), 5)
    assert value.shape == (256,)
