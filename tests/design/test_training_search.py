"""Training: descents by the error of a reconstruction of photographs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design import small

from thincam_jax.design import DesignSpace
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.search import NonFiniteObjectiveError, evaluate
from thincam_jax.design.space import Limits
from thincam_jax.design.training_search import (
    TrainingDescents,
    TrainingError,
    TrainingSettings,
    base_point,
    build_training,
    start_points,
    training_pixels,
)
from thincam_jax.imaging.targets import sample_image
from thincam_jax.reconstruction import phase_pairs

SETTINGS = TrainingSettings(samples=2, starts=1, steps=2, grid=5)
KEY = jax.random.key(3)


def training(pixels=32):
    space = small.problem().space
    given = [sample_image("camera", linear=True)], space, small.setup(), phase_pairs(2)
    return build_training(*given, pixels=pixels, key=KEY)


@pytest.fixture(scope="module")
def problem():
    return DesignProblem(TrainingError("wiener"), small.problem().space, training())


@dataclasses.dataclass(frozen=True)
class Basins:
    """Of both β: the lowest at (15, 15), another at (27, 20), and NaN beside."""

    def __call__(self, design, data):
        first, second = design.beta[0], design.beta[2]
        value = jnp.minimum(
            (first - 15) ** 2 + (second - 15) ** 2, 0.5 + (first - 27) ** 2 + (second - 20) ** 2
        )
        return jnp.where(first < 14.5, jnp.nan, value)


def starts_of(space, settings, *points):
    def values(at):
        return np.asarray(evaluate(Basins(), space, None, at))

    return start_points(space, values, [np.array(point) for point in points], settings, KEY)


def test_descents_begin_at_the_best_points_apart(problem):
    settings = TrainingSettings(samples=128, starts=4)
    space = problem.space
    starts, count = starts_of(space, settings, [0.0, 0.5], [0.5, 0.9])
    assert count == 2 + 1 + 128  # with the base
    values = np.asarray(evaluate(Basins(), space, None, starts))
    assert np.all(values[:2] < 4)
    assert np.all(np.diff(values) >= 0)
    apart = np.abs(starts[:, None] - starts).max(axis=-1)[np.triu_indices(4, 1)]
    assert np.all(apart >= 0.05)
    betas = np.asarray([space.values(p) for p in starts])
    assert {bool(b > 21) for b in betas[:, 0]} == {True, False}  # a start in either basin


def test_the_base_lies_in_the_cube():
    """With a free width, too, where the widest mask leaves β no room."""

    def space(betas, limits=None):
        shared = small.shared("beta", 12.0, 30.0, 2 * len(betas))
        return DesignSpace(small.pairs(betas), (shared, small.shared("width", 1.0, 2.5, 0)), limits)

    tied = space([13.5], Limits(mask_pixel=np.pi / 12 / 2.5))
    point = base_point(tied)
    np.testing.assert_allclose(point, [1 / 1.5, 0.5], atol=1e-9)
    np.testing.assert_allclose(tied.values(jnp.asarray(point)), [2.0, 13.5])
    assert base_point(space([20.0])) is not None
    assert base_point(space([20.0, 19.0])) is None  # two β, and one free


def test_training_is_of_the_sensor_and_the_picture():
    built = training()
    # The field is 1.8 mm of the sensor's 1.92.
    assert built.sensor.shape == (32, 32)
    assert float(built.sensor.pitch) == pytest.approx(0.06)
    assert built.images.shape == (1, 30, 30)
    assert float(built.images.mean()) == pytest.approx(1)


def test_pixels_show_the_finest_fringes():
    """30 rad/mm² over 1 mm are 9.55 cycles/mm: three pixels each of them, 55.003 over 1.92 mm."""
    space, setup = small.problem().space, small.setup()
    assert training_pixels(space, setup, (48, 64)) == 48  # as many as there are
    assert training_pixels(space, setup, (96, 128)) == 56


@pytest.mark.thorough
def test_descents_end_lower_than_they_began(problem):
    settings = dataclasses.replace(SETTINGS, steps=12)
    start = np.array([0.9, 0.05])
    descents = TrainingDescents(problem, [start], settings, KEY)
    for number in range(2):  # there is one
        descents.descend(number)
    trained = descents.finish()
    errors = [one.objective for one in trained.found]
    assert 0 < errors[0] < trained.reference
    begun = evaluate(
        problem.objective, problem.space, problem.data, jnp.asarray(start[None]), at_a_time=1
    )
    assert errors[0] < float(begun[0])
    assert trained.evaluations > 4 + 1  # more than those of the candidates, and a step
    for one in trained.found:
        assert np.all(np.asarray(one.values) >= np.asarray(problem.space.lower))
        assert np.all(np.asarray(one.values) <= np.asarray(problem.space.upper))


def test_an_error_that_is_nan_is_refused(problem):
    descents = TrainingDescents.__new__(TrainingDescents)
    descents.problem, descents.settings, descents.ended = problem, SETTINGS, []
    with pytest.raises(NonFiniteObjectiveError, match="is NaN at any start; give reconstruction"):
        descents.finish()
