"""A deep and colourful scene by plan and in full, in one run: ratio of times, and true error.

32 planes from 100 mm to 10 m with photographs in them, 31 wavelengths from 450 to 650 nm, the
thesis' camera at 1024×1024 pixels in float32. In full every plane and wavelength is computed; the
convolutions of a plane are one already, of the sum of its PSFs. The error is that of the noise-free
capture against the same in double precision, relative L2 with the mean and without.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data

import thincam_jax as tc

SHAPE, PLANES, COLOURS, TOLERANCE = (1024, 1024), 32, 31, 1e-2


def single(value):
    return jnp.asarray(value, jnp.float32)


def thesis_camera():
    mask = tc.FresnelZoneAperture(
        single(25.0),
        single(0.0),
        width=single(5.632),
        centre=jnp.zeros(2, jnp.float32),
        fill_factor=single(1.0),
    )
    sensor = tc.Sensor(SHAPE, single(5.5e-3), full_well=single(13_500.0))
    return tc.LenslessCamera(mask, sensor, single(6.5))


def deep_scene():
    """In each plane a patch of a photograph, elsewhere in each; fields of 0.25 rad."""
    random = np.random.default_rng(0)
    photographs = [
        np.asarray(image, np.float32)[:256, :384].mean(-1) / 255
        for image in (skimage.data.astronaut(), skimage.data.chelsea(), skimage.data.coffee())
    ]
    planes = []
    for i, distance in enumerate(np.geomspace(100.0, 10_000.0, PLANES)):
        image = np.zeros((256, 384), np.float32)
        row, column = random.integers(0, 160), random.integers(0, 280)
        patch = slice(row, row + 96), slice(column, column + 100)
        image[patch] = photographs[i % 3][patch]
        planes.append(tc.ImagePlane(image, single(distance), single(0.25 * distance)))
    wavelengths = np.linspace(450e-6, 650e-6, COLOURS)
    weights = np.exp(-(((wavelengths - 550e-6) / 60e-6) ** 2))
    return tc.Scene(planes, tc.Spectrum(single(wavelengths), single(weights / weights.sum())))


def timed(function, rounds):
    """Best of some calls after one that compiles, and the last value."""
    times, value = [], jax.block_until_ready(function())
    for _ in range(rounds):
        start = time.perf_counter()
        value = jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return float(np.median(times)), value


@pytest.mark.benchmark(group="plan")
def test_plan(benchmark, capsys):
    camera, scene = thesis_camera(), deep_scene()
    tc.plan_capture(camera, scene, tolerance=TOLERANCE, over_field=False)  # compiles
    start = time.perf_counter()
    plan = tc.plan_capture(camera, scene, tolerance=TOLERANCE, over_field=False)
    planning = time.perf_counter() - start
    running, planned = timed(lambda: tc.capture(camera, scene, model=plan), 5)
    everything, _ = timed(lambda: tc.capture(camera, scene), 1)
    double = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (camera, scene))
    exact = np.asarray(tc.capture(*double))
    benchmark.pedantic(
        lambda: jax.block_until_ready(tc.capture(camera, scene, model=plan)), rounds=5
    )
    difference = np.linalg.norm(np.asarray(planned, float) - exact)
    error = difference / np.linalg.norm(exact)
    without_mean = difference / np.linalg.norm(exact - exact.mean())
    benchmark.extra_info.update(
        error=error,
        ratio=everything / running,
        ratio_with_planning=everything / (running + planning),
    )
    with capsys.disabled():
        print(f"\n\n{plan}\n")
        print(f"in full {everything:.2f} s, by plan {running:.2f} s, planning {planning:.2f} s")
        print(
            f"the plan runs {everything / running:.0f} times faster, with planning "
            f"{everything / (running + planning):.1f} times"
        )
        print(f"true error {error:.1e} ({without_mean:.1e} without the mean)\n")
    assert error <= plan.predicted_error <= TOLERANCE
