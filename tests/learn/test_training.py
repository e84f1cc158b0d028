"""Training: it learns, survives NaN, goes on to the same bits; and a learned τ."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction.test_choose_tau import posed, solved

from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.tau import learn_tau
from thincam_jax.learn.training import (
    Task,
    TrainingOptions,
    TrainingState,
    read_state,
    train_model,
    write_state,
)
from thincam_jax.reconstruction.problem import with_tau

OPTIONS = TrainingOptions(steps=40, rate=0.1, warm_up=5, check_every=10, averaging=0.8)


class Line(eqx.Module):
    """y = weight·x, and a whole number, which is not trained."""

    weight: jax.Array
    fixed: jax.Array
    name: str = eqx.field(static=True, default="line")


def draw(key):
    x = jax.random.normal(key, (8, 3))
    return x, x @ jnp.asarray([1.0, -2.0, 0.5])


def loss(model, examples):
    x, y = examples
    error = jnp.mean((x @ model.weight - model.fixed.astype(y.dtype) * y) ** 2)
    return error, {"error": error}


TASK = Task(draw, loss, (draw(jax.random.key(7)),))
MODEL = Line(jnp.zeros(3), jnp.asarray(1))
SETTINGS = dataclasses.asdict(OPTIONS)


def test_it_learns_and_tells_how_it_goes():
    told, kept = [], []
    trained = train_model(TASK, MODEL, OPTIONS, keep=kept.append, callback=told.append)
    assert trained.status == "finished" and [state.step for state in kept] == [10, 20, 30, 40]
    state = trained.state
    assert state.scores[-1] < 0.5 * state.scores[0] and np.isfinite(state.losses).all()
    assert int(trained.model.fixed) == 1 and trained.model.name == "line"
    # The best is what the lowest score was told of.
    found = float(loss(trained.model, TASK.validation[0])[0])
    assert found == pytest.approx(np.min(state.scores)) and found == pytest.approx(told[-1].score)
    assert [progress.step for progress in told] == list(range(1, 41))
    assert told[-1].seconds_left == 0 < told[5].seconds_left
    assert told[0].parts == {"error": told[0].loss}


def test_states_go_through_files_and_go_on_to_the_same_bits(tmp_path):
    file, kept = tmp_path / "state", []
    whole = train_model(TASK, MODEL, OPTIONS, keep=kept.append).state
    write_state(file, kept[1], SETTINGS)
    begun = TrainingState.begin(MODEL, OPTIONS)
    state = read_state(file, begun, SETTINGS)
    assert state.step == 20
    assert eqx.tree_equal(train_model(TASK, MODEL, OPTIONS, state=state).state, whole)
    other = {**SETTINGS, "rate": 0.5}
    with pytest.raises(CheckpointError, match=r"a training whose rate was 0\.1 and is 0\.5 here"):
        read_state(file, begun, other)


def with_faults(of_step):
    """Examples that are NaN at some steps, by how often these were tried."""
    tried: dict[int, int] = {}
    keys = {}
    for step in range(OPTIONS.steps):
        for retreats in range(6):
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), step), retreats)
            keys[jax.random.key_data(key).tobytes()] = step

    def faulty(key):
        step = keys[jax.random.key_data(key).tobytes()]
        tried[step] = tried.get(step, 0) + 1
        x, y = draw(key)
        return x * (jnp.nan if of_step(step, tried[step]) else 1.0), y

    return dataclasses.replace(TASK, draw=faulty)


def test_a_step_that_is_no_number_changes_nothing():
    task = with_faults(lambda step, _: step in (12, 13, 25))
    state = train_model(task, MODEL, OPTIONS).state
    assert (state.skipped, state.retreats) == (3, 0)
    assert np.flatnonzero(np.isnan(state.losses)).tolist() == [12, 13, 25]
    assert state.scores[-1] < 0.5 * state.scores[0]


def test_three_in_a_row_go_back_at_half_the_rate():
    task, seen = with_faults(lambda step, again: 12 <= step < 15 and again == 1), []
    trained = train_model(task, MODEL, OPTIONS, callback=seen.append)
    assert trained.status == "finished"
    assert (trained.state.skipped, trained.state.retreats) == (3, 1)
    assert [progress.step for progress in seen][13:17] == [14, 10, 11, 12]  # back to step 10
    assert np.isfinite(trained.state.losses).all()


def test_what_never_becomes_a_number_ends_with_the_best_so_far():
    task = with_faults(lambda step, _: step >= 12)
    trained = train_model(task, MODEL, OPTIONS)
    assert trained.status == "diverged" and trained.state.skipped == 15
    found = float(loss(trained.model, TASK.validation[0])[0])
    assert found == pytest.approx(trained.state.scores[0])


@pytest.mark.thorough
def test_learning_finds_the_least_error_of_known_images():
    pairs = [posed(seed, tau=0.3) for seed in (0, 1)]
    problems, truths = zip(*pairs, strict=True)
    factor, course = learn_tau(problems, truths, steps=12, iterations=200)

    def error(factor):
        images = [solved(with_tau(p, p.tau * factor)) for p in problems]
        pairs = zip(images, truths, strict=True)
        return np.mean([float(jnp.mean((image - truth) ** 2)) for image, truth in pairs])

    assert course[0] == pytest.approx(error(1.0), rel=1e-3)
    assert course[-1] < 0.95 * course[0]
    assert error(float(factor)) < 1.02 * min(error(f) for f in np.geomspace(0.5, 20, 9))


def test_a_callback_stops_it():
    trained = train_model(TASK, MODEL, OPTIONS, callback=lambda progress: progress.step == 15)
    assert trained.status == "stopped" and trained.state.step == 15


def test_what_cannot_be_learned_from_is_refused():
    with pytest.raises(ValueError, match="0 problems, 1 images; give one for each"):
        learn_tau([], [jnp.zeros((1, 1, 3, 4))])
