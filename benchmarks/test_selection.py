"""Is the model that `choose_model` chooses the fastest that is accurate enough? Measured times.

100 random cameras in single precision, numbers log-uniform in wide ranges, on sensors of 64² to
1024² pixels. Every closed form is timed in both precisions, `angular_spectrum` too on the smallest
sensor (elsewhere, as the direct sum everywhere, it is slower by orders of magnitude): compiled and
warmed up, the result waited for, medians. The ways take turns in random order, so that a slow
moment of the machine hits them all.

A way meets a tolerance if its error from `separable` in double precision does, the PSF that errors
are counted from; the tests compare that with a reference of their own. A choice is the fastest if
it meets the tolerance and takes at most 25 % and 0.1 ms more than the fastest way that does. The
sizes that compile anew are few, and the times of compilation are told apart.
"""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc

TOLERANCES = (0.3, 0.1, 1e-2, 1e-3, 1e-5)
SHAPES = ((64, 64), (256, 192), (512, 700), (1024, 1024))
CLOSED = ("geometric", "paraxial", "closed_form", "separable")
PRECISIONS = ("float32", "float64")
CAMERAS, ROUNDS = 100, 15


def random_cameras():
    """Cameras with their conditions; those of the smallest sensor have masks it can sample."""
    rng = np.random.default_rng(5)

    def log_uniform(low, high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    for number in range(CAMERAS):
        shape = SHAPES[number % len(SHAPES)]
        pitch, width = log_uniform(1e-3, 20e-3), log_uniform(0.5, 20)
        if shape == SHAPES[0]:
            # Masks of up to 128 pixels, so that the window of the transforms has one size.
            width = pitch * (128 - rng.uniform())
        phase = rng.uniform(0, 2 * np.pi)
        mask = tc.FresnelZoneAperture(log_uniform(1, 200), phase, width=width)
        camera = tc.LenslessCamera(mask, tc.Sensor(shape, pitch), log_uniform(0.2, 50))
        far = math.inf if rng.uniform() < 0.2 else log_uniform(5, 1e5)
        wavelength = log_uniform(400e-6, 1000e-6)
        # Single precision is what JAX gives unless told otherwise: no numbers are converted for it.
        single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), camera)
        yield single, {"wavelength": jnp.float32(wavelength), "object_distance": jnp.float32(far)}


def ways_of(camera):
    models = CLOSED
    if camera.sensor.grid.shape == SHAPES[0]:
        models = (*CLOSED, "angular_spectrum")
    return [(model, precision) for model in models for precision in PRECISIONS]


def evaluate(camera, conditions, way):
    model, precision = way
    return jax.block_until_ready(
        tc.psf(camera, model=tc.PsfMethod(model, precision), **conditions, pixel_integration=False)
    )


def in_double(*trees):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64), trees)


def measure(camera, conditions):
    """Median time in ms, relative error, and seconds of the first call, of every way."""
    exact = evaluate(*in_double(camera, conditions), ("separable", "float64"))
    exact = np.asarray(exact)
    scale = np.linalg.norm(exact) or 1.0
    errors, first = {}, {}
    for way in ways_of(camera):
        start = time.perf_counter()
        value = evaluate(camera, conditions, way)
        first[way] = time.perf_counter() - start
        if way[1] == "float64":  # as it is before it is rounded to the camera's precision
            value = evaluate(*in_double(camera, conditions), way)
        errors[way] = float(np.linalg.norm(np.asarray(value, float) - exact) / scale)
    times = {way: [] for way in errors}
    rng = np.random.default_rng(1)
    for _ in range(ROUNDS):
        for index in rng.permutation(len(times)):
            way = list(times)[index]
            start = time.perf_counter()
            evaluate(camera, conditions, way)
            times[way].append((time.perf_counter() - start) * 1e3)
    return {way: float(np.median(found)) for way, found in times.items()}, errors, first


def judge(camera, conditions, tolerance, times, errors):
    """Whether the choice meets the tolerance, and its time over that of the fastest that does."""
    start = time.perf_counter()
    choice = tc.choose_model(camera, tolerance=tolerance, **conditions, pixel_integration=False)
    took = time.perf_counter() - start
    way = (choice.method.model, choice.method.precision)
    met = errors.get(way, math.inf) <= tolerance
    fastest = min(times[w] for w, error in errors.items() if error <= tolerance)
    own = times.get(way, math.inf)
    return {
        "met": met,
        "fastest": met and own <= 1.25 * fastest + 0.1,
        "own": own,
        "ratio": own / fastest,
        "way": way,
        "select_ms": took * 1e3,
    }


@pytest.mark.benchmark(group="selection")
def test_choices(benchmark, capsys):
    """Rates of choices that meet the tolerance, and that are also the fastest: printed."""
    judged = {tolerance: [] for tolerance in TOLERANCES}
    compile_seconds, medians = 0.0, {}

    def run():
        nonlocal compile_seconds
        for camera, conditions in random_cameras():
            times, errors, first = measure(camera, conditions)
            compile_seconds += sum(first.values()) - sum(times.values()) / 1e3
            for way, value in times.items():
                medians.setdefault((camera.sensor.grid.shape, *way), []).append(value)
            for tolerance, found in judged.items():
                found.append(judge(camera, conditions, tolerance, times, errors))

    benchmark.pedantic(run, rounds=1, iterations=1)
    lines = [f"\n{CAMERAS} random cameras; compiling took {compile_seconds:.0f} s, apart"]
    lines += [
        f"{shape[0]}×{shape[1]} {model} {precision}: {np.median(values):.2f} ms"
        for (shape, model, precision), values in sorted(medians.items())
    ]
    lines.append("tolerance     met  fastest too  time/fastest (median, 95 %)  select ms  choices")
    for tolerance, found in judged.items():
        met, fastest = (np.mean([f[k] for f in found]) for k in ("met", "fastest"))
        ratios = np.quantile([f["ratio"] for f in found], [0.5, 0.95])
        names = [f"{f['way'][0]} {f['way'][1]}" for f in found]
        select_ms = np.median([f["select_ms"] for f in found])
        benchmark.extra_info[f"{tolerance:g}"] = {"met": met, "fastest": fastest}
        lines.append(
            f"{tolerance:9g}{met:8.0%}{fastest:13.0%}{ratios[0]:15.2f}, {ratios[1]:.2f}"
            f"{select_ms:17.0f}  "
            + ", ".join(f"{name} {names.count(name)}" for name in sorted(set(names)))
        )
    with capsys.disabled():
        print("\n".join(lines))
    for tolerance, found in judged.items():
        assert np.mean([f["met"] for f in found]) >= 0.9, tolerance
        assert np.mean([f["fastest"] for f in found]) >= 0.9, tolerance
