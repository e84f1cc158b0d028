"""Search problems: frequencies, and what changes with thickness, light and captures."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from design import small

from thincam_jax.design import BayesError, DesignSpace, FrequencyCounts, PhotonNoise, design_problem
from thincam_jax.design.objectives import bayes_error, channels
from thincam_jax.design.setup import Quadrant
from thincam_jax.design.space import Limits
from thincam_jax.reconstruction import phase_pairs


def test_frequencies_reach_half_of_the_nyquist_frequency_at_the_longest_distance():
    variables = (*small.BETAS, small.shared("distance", 2.0, 5.0))
    base = small.pairs()
    for limit, longest in ((None, 5.0), (4.0, 4.0), (2.5, 3.0)):  # the base has 3 mm
        space = DesignSpace(base, variables, Limits(thickness=limit))
        counts = FrequencyCounts(64, 1)
        problem = design_problem(BayesError(), space, small.setup(), phase_pairs(2), counts)
        for data in (problem.data, problem.exact):
            assert float(data.frequencies.highest) == pytest.approx(longest * 12.5 / 2)
    assert isinstance(problem.exact.frequencies, Quadrant)
    assert len(problem.exact.frequencies.axis) == 128  # the fewest
    space = DesignSpace(base, (small.shared("width", 2.0, 40.0, 0),))
    assert space.reach("width") == (2.0, 40.0)
    wide = design_problem(BayesError(), space, small.setup(), phase_pairs(2))
    # Fringes of a shadow of 40 (1 + 3/100)/3 rad, to either side, up to 18.75 cycles/rad.
    assert len(wide.exact.frequencies.axis) == int(np.ceil(2.2 * 41.2 / 3 * 18.75)) + 1


def test_thickness_ends_the_distances_only():
    problem = small.problem(variables=(*small.BETAS, small.shared("distance", 2.0, 3.0)))
    thin = problem.with_thickness(2.5).space
    np.testing.assert_allclose(thin.upper, [30, 30, 2.5])
    np.testing.assert_allclose(problem.with_thickness(9.0).space.upper, [30, 30, 3])


def error_of_copies(problem, count):
    """Expected error of copies of one shot, seen by an endless sensor."""
    space = DesignSpace(small.pairs([25.0] * count), small.BETAS[:1], Limits(captures=8))
    given = problem.with_captures(space, jnp.asarray(phase_pairs(count)))
    divided = isinstance(problem.data.setup.noise, PhotonNoise)
    np.testing.assert_allclose(given.space.base.exposure, 2 / count if divided else 1.0)
    data = eqx.tree_at(lambda d: d.setup.sensor_width, given.data, jnp.asarray(50.0))
    # Rings are compiled faster than the exact response.
    numbers = data.setup, data.synthesis, data.frequencies
    return float(eqx.filter_jit(lambda d: bayes_error(channels(d, *numbers)))(given.space.base))


@pytest.mark.thorough
def test_captures_share_the_exposure():
    """Two halves of an exposure are a whole one, but for the read noise of each."""
    errors = {}
    for name, read_noise in (("none", 0.0), ("some", 100.0)):
        problem = small.problem(noise=PhotonNoise(9000.0, read_noise))
        errors[name] = [error_of_copies(problem, count) for count in (1, 2)]
    assert errors["none"][1] == pytest.approx(errors["none"][0], rel=1e-9)
    assert errors["some"][1] > 1.01 * errors["some"][0]


@pytest.mark.thorough
def test_frequencies_stay_few_however_many_fringes_a_sensor_has():
    """Close at zero, farther apart above: the errors of even samples, to 0.01 dB."""
    space = DesignSpace(small.pairs(), (small.shared("width", 2.0, 120.0, 0),))
    many = design_problem(BayesError(), space, small.setup(), phase_pairs(2))
    axis = np.asarray(many.exact.frequencies.axis)
    assert len(axis) == 384
    needed = int(np.ceil(2.2 * 123.6 / 3 * 18.75)) + 1
    assert axis[0] == 0 and axis[-1] == pytest.approx(18.75)
    assert axis[1] == pytest.approx(18.75 / (needed - 1), rel=0.01)
    assert np.all(np.diff(axis, 2) > -1e-6)
    numbers = small.setup(), jnp.asarray(phase_pairs(2))
    even, few = Quadrant(18.75, 1400), Quadrant(18.75, 128, 640)
    for betas, width in (((25.0, 21.0), 2.0), ((14.0, 29.0), 3.0)):
        design = small.pairs(betas, width=width)
        errors = [float(bayes_error(channels(design, *numbers, each))) for each in (even, few)]
        assert 10 * np.log10(errors[1] / errors[0]) == pytest.approx(0, abs=0.01)
    assert float(few.weight.sum()) == pytest.approx((2 * 18.75) ** 2)
    ring = few.ring(8).reshape(128, 128)
    np.testing.assert_array_equal(ring[0, :-1], np.floor(8 * few.axis[:-1] / 18.75))
