"""Design for an own sensor: beside an exhaustive grid, with its plateaus, at a bounded cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design.landscape import evaluate_grid
from thincam_jax.design.own_sensor import beta_bounds
from thincam_jax.design.search import evaluate
from thincam_jax.units import um


def test_bounds_are_two_zones_and_two_pixels_a_period():
    low, high = beta_bounds(0.00345, 5.175)
    assert low * 5.175**2 / 4 == pytest.approx(2 * 2 * np.pi)
    assert high * (5.175 / 2) / np.pi == pytest.approx(1 / (2 * 0.00345))  # cycles/mm at the edge
    few = beta_bounds(0.1, 0.8)
    assert 0 < few[0] < few[1]


@pytest.mark.parametrize("given", [(10.0, 3.0), (0.0, 3.0), (3.0, float("inf"))])
def test_distances_that_cross_are_refused(given):
    with pytest.raises(ValueError, match=r"give the least and the most in mm, such as \(3, 10\)"):
        tc.design.for_sensor(tc.Sensor((12, 16), 100 * um), distance=given)


@pytest.mark.thorough
def test_no_worse_than_an_exhaustive_grid():
    found = tc.design.for_sensor(tc.Sensor((60, 80), 40 * um), distance=(3.0, 6.0))
    problem, best = found.problem, found.best
    with jax.enable_x64(True):
        points, costs = evaluate_grid(problem.objective, problem.space, problem.data, 17)
        lowest = points[np.argsort(costs)[:8]]
        numbers = problem.objective, problem.space, problem.exact
        exact = np.asarray(evaluate(*numbers, lowest, at_a_time=1))
        assert best.objective < 1.001 * exact.min()
        for n, (low, high) in enumerate(found.plateaus):
            assert low <= best.values[n] <= high
            lower, upper = problem.space.lower[n], problem.space.upper[n]
            ends = (jnp.array([low, high]) - lower) / (upper - lower)
            inside = jnp.tile(best.point, (2, 1)).at[:, n].set(ends)
            worse = 10 * np.log10(np.asarray(evaluate(*numbers, inside, at_a_time=1)))
            assert np.all(worse - found.errors_db[0] <= 0.1 + 1e-6)
    own, usual, random = found.errors_db
    assert own <= min(usual, random)
    assert found.evaluations < 1600
    text = str(found)
    assert "β of shot 1, rad/mm²" in text and "the thesis' pair" in text
    assert text.count("is within 0.1 dB") == 3


@pytest.mark.thorough
def test_frequencies_and_evaluations_do_not_grow_with_the_pixels():
    found = tc.design.for_sensor(tc.Sensor((3000, 4000), 2 * um), noise=tc.design.SignalNoise(25.0))
    assert [len(d.frequencies.axis) for d in (found.problem.data, found.problem.exact)] == [
        128,
        256,
    ]
    assert found.evaluations < 1600
