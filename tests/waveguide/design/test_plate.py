"""Plates by gradient: the expected error against a small exact system, and what a search finds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design import PowerLaw
from thincam_jax.units import deg, um
from thincam_jax.waveguide import ObjectPlane, system_operator
from thincam_jax.waveguide.design.plate import (
    Plate,
    PlateLimits,
    Viewing,
    find_plate,
    judge_plate,
    noise_variance,
)
from thincam_jax.waveguide.field_of_view import field_of_view

# 10×10 cells of 15 mm; pixels that see 6.6 mm of the object.
VIEWING = Viewing(tc.Sensor((30, 30), 70.4 * um), cell=15.0)


def changed(plate=None, **numbers):
    given = {name: jnp.asarray(value, float) for name, value in numbers.items()}
    return dataclasses.replace(Plate() if plate is None else plate, **given)


@pytest.mark.thorough
def test_gradient_against_finite_differences():
    slopes = eqx.filter_grad(lambda plate: judge_plate(plate, VIEWING).error)(Plate())
    for name, step in (
        ("glass_thickness", 1e-3),
        ("reference_angle", 1e-5),
        ("film_thickness", 1e-6),
        ("index_modulation", 1e-6),
        ("lens_distance", 1e-2),
        ("focal_distance", 1e-4),
    ):
        value = getattr(Plate(), name)
        high, low = (
            judge_plate(changed(**{name: value + sign * step}), VIEWING).error for sign in (1, -1)
        )
        expected = float(high - low) / (2 * step)
        assert float(getattr(slopes, name)) == pytest.approx(expected, rel=1e-3), name


@pytest.mark.thorough
@pytest.mark.parametrize("numbers", [{"index_modulation": 0.008, "film_thickness": 10 * um}, {}])
def test_expected_error_is_that_of_the_exact_system(numbers):
    """Trace of the posterior covariance of 10×10 cells, the prior's covariance in the exact one."""
    plate = changed(**numbers)
    judged = judge_plate(plate, VIEWING)
    camera = plate.camera(VIEWING.sensor)
    seen = ObjectPlane((10, 10), 550.0, 150.0, (18.0, 0.0))
    operator = system_operator(camera, seen, orders=4, samples=6)
    matrix = np.zeros((30 * 30, 100))
    np.add.at(matrix, (np.asarray(operator.rows), np.asarray(operator.columns)), operator.values)
    y, x = (np.fft.fftfreq(20, 15.0) for _ in range(2))
    spectrum = np.asarray(PowerLaw(2.5)(jnp.asarray(y[:, None] ** 2 + x**2), jnp.asarray(150.0)))
    correlation = np.fft.ifft2(spectrum).real
    correlation *= 0.08 / correlation[0, 0]
    rows, columns = np.divmod(np.arange(100), 10)
    prior = correlation[rows[:, None] - rows, columns[:, None] - columns]
    noise = float(noise_variance(VIEWING, judged.light) / judged.light**2)
    posterior = np.linalg.inv(np.linalg.inv(prior) + matrix.T @ matrix / noise)
    exact = np.trace(posterior) / np.trace(prior)
    assert float(judged.error) == pytest.approx(exact, rel=0.35)


@pytest.mark.thorough  # a shorter one is in experiments/sts_design.py
def test_a_search_beats_the_default_within_its_limits():
    lower = changed(reference_angle=45 * deg, film_thickness=8 * um, index_modulation=0.005)
    upper = changed(reference_angle=70 * deg, film_thickness=25 * um, index_modulation=0.03)
    limits = PlateLimits(lower, upper)
    found = find_plate(VIEWING, limits, key=jax.random.key(0), starts=1, samples=16, steps=8)
    assert found.error < 0.65 * float(judge_plate(Plate(), VIEWING).error)
    assert found.error == found.history.min() < found.history[0]
    assert found.error == pytest.approx(float(judge_plate(found.plate, VIEWING).error))
    for name in Plate.__dataclass_fields__:
        low, value, high = (float(getattr(p, name)) for p in (lower, found.plate, upper))
        assert low <= value <= high
    assert float(found.plate.glass_thickness) == 5.0  # fixed


def test_limits_that_cross_are_refused():
    limits = PlateLimits(changed(index_modulation=0.03), Plate())
    with pytest.raises(ValueError, match="limits of index_modulation are 0.03 to 0.02; give the"):
        find_plate(VIEWING, limits, key=jax.random.key(0))


@pytest.mark.parametrize(
    "numbers",
    [
        {},  # the sensor's edges
        {"focal_distance": 0.8, "reference_angle": 46 * deg},  # the critical angle on one side
        {"focal_distance": 0.8, "reference_angle": 80 * deg},  # grazing light on the other
        {"reference_angle": 35 * deg},  # nothing
    ],
)
def test_field_of_view_is_that_of_traced_rays(numbers):
    plate = changed(**numbers)
    traced = field_of_view(plate.camera(VIEWING.sensor)).vertical_deg
    assert float(judge_plate(plate, VIEWING).field_of_view) / deg == pytest.approx(traced, abs=0.05)


@pytest.mark.thorough
def test_a_plate_with_a_least_field_of_view():
    lower = changed(reference_angle=45 * deg, focal_distance=2.0)
    upper = changed(reference_angle=85 * deg, focal_distance=10.0)
    wide = dataclasses.replace(VIEWING, field_of_view=50 * deg)
    settings = {"key": jax.random.key(0), "starts": 1, "samples": 4, "steps": 4}
    found = [find_plate(v, PlateLimits(lower, upper), **settings).plate for v in (VIEWING, wide)]
    narrow, asked = (field_of_view(one.camera(VIEWING.sensor)).vertical_deg for one in found)
    assert narrow < 45 and asked > 49.97


@pytest.mark.parametrize(
    ("numbers", "part"),
    [
        ({}, "limits of focal_distance are 6 to 6 mm; a field of view of 50 deg takes 0 to 2.265"),
        (
            {"focal_distance": 2.0, "reference_angle": 50 * deg},
            "limits of reference_angle are 50 to 50 deg; a field .* takes 58.17 to 73.64 deg;",
        ),
    ],
)
def test_limits_without_the_field_of_view_are_refused(numbers, part):
    end, wide = changed(**numbers), dataclasses.replace(VIEWING, field_of_view=50 * deg)
    with pytest.raises(ValueError, match=part):
        find_plate(wide, PlateLimits(end, end), key=jax.random.key(0))
    with pytest.raises(ValueError, match="field_of_view = 4 rad; give 0 for any, or less than π"):
        dataclasses.replace(VIEWING, field_of_view=4.0)
