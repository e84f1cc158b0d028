"""Training: descents by the error of a reconstruction."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from commands.design import tiny
from commands.study.tiny import Told

from thincam_jax.commands.design.problem import build_problem
from thincam_jax.commands.design.ranking import Finder
from thincam_jax.commands.design.train import (
    TrainingDescents,
    _reference_point,
    build_training,
    start_points,
)
from thincam_jax.commands.run_folder import carry_out
from thincam_jax.design import wiener_error
from thincam_jax.design.search import evaluate

ASKED = (
    "train.images=[camera]",
    "train.pixels=32",
    "train.samples=2",
    "train.starts=1",
    "train.steps=2",
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return tiny.built(tmp_path_factory.mktemp("train"), *ASKED)


@pytest.fixture(scope="module")
def config(study):
    return study.config


def setup_of(study):
    return build_problem(study).data.setup


@pytest.fixture(scope="module")
def trained(study, config):
    wanted = config.train.model_copy(update={"steps": 12})
    descents = TrainingDescents(config, wanted, setup_of(study), [np.array([0.9, 0.05])])
    for number in range(2):  # there is one
        descents.descend(number)
    return descents.finish()


@dataclasses.dataclass(frozen=True)
class Basins:
    """Of both β: the lowest at (15, 15), another at (27, 20), and NaN beside."""

    def __call__(self, design, data):
        first, second = design.beta[0], design.beta[2]
        value = jnp.minimum(
            (first - 15) ** 2 + (second - 15) ** 2, 0.5 + (first - 27) ** 2 + (second - 20) ** 2
        )
        return jnp.where(first < 14.5, jnp.nan, value)


def starts_of(space, wanted, *points):
    def values(at):
        return np.asarray(evaluate(Basins(), space, None, at))

    return start_points(space, values, [np.array(point) for point in points], wanted, 3)


def test_descents_begin_at_the_best_points_apart(config):
    wanted = config.train.model_copy(update={"samples": 128, "starts": 4})
    space, nowhere = config.space(), [0.0, 0.5]
    starts, count = starts_of(space, wanted, nowhere, [0.5, 0.9])
    assert count == 2 + 1 + 128  # with the reference
    values = np.asarray(evaluate(Basins(), space, None, starts))
    assert np.all(values[:2] < 4)
    assert np.all(np.diff(values) >= 0)
    apart = np.abs(starts[:, None] - starts).max(axis=-1)[np.triu_indices(4, 1)]
    assert np.all(apart >= 0.05)
    betas = np.asarray([space.values(p) for p in starts])
    assert {bool(b > 21) for b in betas[:, 0]} == {True, False}  # a start in either basin


def test_the_reference_lies_in_the_cube(tmp_path):
    """With a free width, too, where the widest mask leaves β no room."""
    free = (
        "search.free=[{variable: beta, bounds: [12 rad/mm^2, 30 rad/mm^2], shared: true}, "
        "{variable: width, bounds: [1 mm, 2.5 mm]}]"
    )
    one = "reference.shots=[{beta: 13.5 rad/mm^2, distance: 3 mm}]"
    limit = f"search.limits.mask_pixel={np.pi / 12 / 2.5!r} mm"
    space = tiny.design(tmp_path, free, one, limit).space()
    point = _reference_point(space)
    np.testing.assert_allclose(point, [1 / 1.5, 0.5], atol=1e-9)
    np.testing.assert_allclose(space.values(jnp.asarray(point)), [2.0, 13.5])
    given = "reference.shots=[{beta: 20 rad/mm^2, distance: 3 mm}]"
    assert _reference_point(tiny.design(tmp_path, free, given).space()) is not None
    two = "reference.shots=[{beta: 20 rad/mm^2, distance: 3 mm}, {beta: 19 /mm^2, distance: 3 mm}]"
    assert _reference_point(tiny.design(tmp_path, free, two).space()) is None  # two β, and one free


def test_the_reference_and_designs_of_the_search_can_be_starts(config):
    wanted = config.train.model_copy(update={"samples": 1, "starts": 10})
    given = [0.18, 0.16]
    starts, count = starts_of(config.space(), wanted, given)
    assert count == 3 >= len(starts)  # the sample may meet NaN
    assert np.asarray(starts[0]) == pytest.approx(given)
    assert any(np.allclose(config.space().values(p), [25.0, 21.0]) for p in starts)


@pytest.mark.thorough
def test_descents_end_lower_than_they_began(study, config, trained):
    errors = [one.objective for one in trained.found]
    assert 0 < errors[0] < trained.reference
    training = build_training(config, config.train, setup_of(study))
    start = evaluate(
        trained.objective, config.space(), training, jnp.asarray([[0.9, 0.05]]), at_a_time=1
    )
    assert errors[0] < float(start[0])
    assert trained.evaluations > 4 + 1  # more than those of the candidates, and a step
    space = config.space()
    for one in trained.found:
        assert np.all(np.asarray(one.values) >= np.asarray(space.lower))
        assert np.all(np.asarray(one.values) <= np.asarray(space.upper))


def test_training_is_of_the_sensor_and_the_picture(study, config):
    training = build_training(config, config.train, setup_of(study))
    # The field is 1.8 mm of the shorter side's 1.92.
    assert training.sensor.shape == (32, 32)
    assert float(training.sensor.pitch) == pytest.approx(0.06)
    assert training.images.shape == (1, 30, 30)
    assert float(training.images.mean()) == pytest.approx(1)


def test_pixels_show_the_finest_fringes(study, config):
    """30 rad/mm² over 1 mm are 9.55 cycles/mm: three pixels each of them, 55.003 over 1.92 mm."""
    asked = config.train.model_copy(update={"pixels": None})
    training = build_training(config, asked, setup_of(study))
    assert training.sensor.shape == (48, 48)  # as many as there are
    fine = config.sensor.model_copy(update={"shape": (96, 128), "pitch": 0.02})
    finer = config.model_copy(update={"sensor": fine})
    assert build_training(finer, asked, setup_of(study)).sensor.shape == (56, 56)


@pytest.mark.thorough
def test_ranked_by_the_training_error(tmp_path):
    # More starts than there are candidates.
    study, steps = tiny.built(tmp_path, *ASKED, "train.starts=10"), Told()
    config, finder = study.config, Finder(study)
    carry_out(finder.work, steps)
    result = finder.result
    assert [text for text in steps if not text.startswith("training")] == [
        "search",
        "around the trained designs",
        "found designs",
        "landscape",
    ]
    assert len(steps) == steps.total == 3 + 1 + 10 + 1
    training = build_training(config, config.train, setup_of(study))
    base = config.design(config.reference)
    error = eqx.filter_jit(wiener_error)
    reference = float(error(base, training))
    assert result.reference.trained == pytest.approx(reference, rel=1e-6)
    errors = [one.trained for one in result.found]
    assert None not in errors and errors == sorted(errors)
    assert result.training.evaluations > 0
    around = result.training.landscape
    assert around.values.shape == (5, 5)
    betas = [jnp.repeat(jnp.asarray(around.axes[n][place]), 2) for n, place in ((0, 1), (1, 3))]
    chosen = eqx.tree_at(lambda d: d.beta, base, jnp.concatenate(betas))
    assert around.values[1, 3] == pytest.approx(float(error(chosen, training)), rel=1e-6)
    for one in result.found:
        assert [v.value for v in one.values] == pytest.approx([s.beta for s in one.shots])
