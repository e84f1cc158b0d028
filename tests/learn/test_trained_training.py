"""Training for one camera: its scenes, its examples, and how it is gone on with."""

import dataclasses
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learn.test_imperfections import NONE
from learn.test_trained import PSF, drawn_psf

from helpers import ROOT
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.denoiser.pictures import Pictures
from thincam_jax.learn.imperfections import Imperfections
from thincam_jax.learn.sources import Entry
from thincam_jax.learn.trained import (
    TrainedOptions,
    TrainedReconstruction,
    cleaned,
    training_record,
    with_whole_field,
)
from thincam_jax.learn.trained_lessons import (
    CameraLessons,
    PairLessons,
    PreparedExamples,
    draw_scene,
)
from thincam_jax.learn.trained_training import (
    NETWORK,
    ReconstructionLessons,
    gains,
    loss,
    tempered,
    train_reconstruction,
)
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.measured import Preparation, prepare
from thincam_jax.measured.layouts import open_pairs
from thincam_jax.measured.raw import Raw

OPTIONS = TrainingOptions(steps=8, rate=3e-3, warm_up=2, check_every=2, averaging=0.5)
SENSOR = 24, 32


def pictures(seed=0, count=4, side=40):
    """Blobs in three colours."""
    y, x = np.mgrid[:side, :side] / side
    rng = np.random.default_rng(seed)
    waves = [np.sin(rng.uniform(4, 20) * (y * np.cos(a) + x * np.sin(a)) + rng.uniform(0, 6))
             for a in rng.uniform(0, 3, 3 * count)]  # fmt: skip
    tiles = (0.5 + 0.5 * np.asarray(waves)).reshape(count, 3, side, side)
    return Pictures(np.moveaxis(tiles, 1, -1).astype(np.float32), (Entry("waves", "0", "drawn"),))


CAMERA = CameraLessons(PSF, SENSOR, pictures())
LESSONS = ReconstructionLessons(
    CAMERA, judge=dataclasses.replace(CAMERA, pictures=pictures(1)),
    fitted=1, pool=4, judged=2, batch=4, crop=16,
)  # fmt: skip


def untrained():
    return TrainedReconstruction.create(TrainedOptions(iterations=5, widths=(4, 4)), PSF, key=0)


def test_scenes_are_those_of_their_seed_and_fill_what_they_say():
    tiles, field = pictures().tiles, (37, 48)

    def drawn(seed, colours=1):
        return draw_scene(tiles, colours, SENSOR, field, np.random.default_rng(seed))

    scenes = [drawn(seed) for seed in range(40)]
    np.testing.assert_array_equal(drawn(3), scenes[3])
    assert drawn(0, 3).shape == (3, 37, 48) and drawn(0, 2).shape == (2, 37, 48)
    lit = np.asarray([np.mean(scene > 0) for scene in scenes])
    assert all(scene.min() >= 0 and scene.max() <= 1 for scene in scenes)
    assert 0.3 < np.mean(lit > 0.4) < 0.8 and lit.min() < 0.15
    # Somewhere beyond the sensor there is light, too.
    assert np.mean([scene[0, :4].max() > 0 for scene in scenes]) > 0.2


def test_an_example_is_an_image_of_its_scene():
    physics = untrained().physics
    exact = dataclasses.replace(NONE, electrons=(1e6, 1e6))
    camera = dataclasses.replace(CAMERA, faults=exact)
    drawn = camera.examples(physics, 0, 3)
    assert drawn.images.shape == (3, 2, 1, *SENSOR) and drawn.truth.shape == (3, 1, *SENSOR)
    assert drawn.truth.dtype == jnp.float16
    for images, truth in zip(drawn.images, drawn.truth, strict=True):
        assert np.corrcoef(np.ravel(images[1]), np.ravel(truth))[0, 1] > 0.7
    again, _ = camera.drawn(0, 1)
    other, _ = camera.drawn(1, 1)
    np.testing.assert_array_equal(again.captures[0], camera.drawn(0, 1)[0].captures[0])
    assert np.abs(np.asarray(again.captures[0]) - np.asarray(other.captures[0])).max() > 0.01


def test_more_noise_is_learned_where_there_is_more():
    """λ of the Wiener filter grows with the noise that drawn captures have."""
    found = []
    for electrons in (1e6, 60.0):
        faults = Imperfections(scale=0.0, turn=0.0, blur=0.0, ambient=0.0,
                               electrons=(electrons, electrons), bits=12)  # fmt: skip
        lessons = ReconstructionLessons(
            dataclasses.replace(CAMERA, faults=faults), fitted=2, crop=8
        )
        found.append(float(lessons.fit(untrained().physics, 0).noise[0]))
    assert found[1] > found[0] + 1


def test_the_network_that_adds_nothing_has_the_loss_of_its_input():
    rng = np.random.default_rng(0)
    images, truth = rng.random((3, 2, 1, 12, 20)), rng.random((3, 1, 12, 20))
    value, parts = loss(
        untrained().network, PreparedExamples(jnp.asarray(images), jnp.asarray(truth))
    )
    squares = np.mean((images[:, 1] - truth) ** 2, axis=(1, 2, 3))
    assert float(value) == pytest.approx(np.mean(np.log(squares)) / 2, rel=1e-3)
    assert float(parts["before"]) == pytest.approx(float(value))


@pytest.mark.parametrize("part", [0.0, 0.25, 1.0])
def test_the_part_of_a_network_is_kept_that_judges_want(part):
    rng, network = np.random.default_rng(0), untrained().network
    leave = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), network.leave)
    network = eqx.tree_at(lambda one: one.leave, network, leave)
    images = jnp.asarray(rng.random((3, 2, 1, 12, 20)))
    added = cleaned(network, 1, jnp.moveaxis(images, 1, 0)) - images[:, -1]
    found, kept = tempered(network, [PreparedExamples(images, images[:, -1] + part * added)])
    assert kept == part
    np.testing.assert_allclose(found.leave.weight, part * network.leave.weight)


@pytest.fixture(scope="module")
def whole():
    return train_reconstruction(untrained(), LESSONS, OPTIONS)


def test_an_interrupted_training_ends_with_the_same_numbers(whole, tmp_path):
    train_reconstruction(
        untrained(), LESSONS, OPTIONS, folder=tmp_path, callback=lambda p: p.step == 5
    )
    steps = []
    resumed = train_reconstruction(
        untrained(), LESSONS, OPTIONS, folder=tmp_path, callback=lambda p: steps.append(p.step)
    )
    assert steps[0] == 5 and steps[-1] == 8
    assert eqx.tree_equal(resumed.state, whole.state)
    assert eqx.tree_equal(resumed.model.network, whole.model.network)
    kept = TrainedReconstruction.load(tmp_path / NETWORK)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), whole.model)
    assert eqx.tree_equal(kept, single)
    assert training_record(tmp_path / NETWORK)["part"] in (0.0, 0.25, 0.5, 0.75, 1.0)
    other = dataclasses.replace(OPTIONS, rate=1e-3)
    with pytest.raises(CheckpointError, match=r"training\.rate was 0\.003 and is 0\.001 here"):
        train_reconstruction(untrained(), LESSONS, other, folder=tmp_path)


@pytest.mark.thorough
def test_it_learns_what_holds_for_captures_that_it_has_not_seen():
    lessons = dataclasses.replace(LESSONS, pool=150, judged=8)
    options = dataclasses.replace(OPTIONS, steps=600, check_every=50, averaging=0.95)
    made = TrainedReconstruction.create(TrainedOptions(iterations=5, widths=(12, 16)), PSF, key=0)
    trained = train_reconstruction(made, lessons, options)
    gain = np.asarray([after - before for before, after in gains(trained.model, lessons, 0)])
    assert gain.mean() > 0.5 and gain.mean() > 2 * gain.std() / len(gain) ** 0.5


CHILD = """
import numpy as np
import jax
from learn import test_trained_training as t
found = t.train_reconstruction(t.untrained(), t.LESSONS, t.OPTIONS)
print(jax.device_count(), *found.state.losses, *found.state.scores)
"""


@pytest.mark.thorough
def test_losses_on_four_devices_are_those_on_one(whole):
    env = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    env |= {"JAX_ENABLE_X64": "1", "JAX_NUMPY_DTYPE_PROMOTION": "strict"}
    env["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"
    done = subprocess.run([sys.executable, "-c", CHILD], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    count, *numbers = done.stdout.split()
    assert count == "4"
    alone = [*whole.state.losses, *whole.state.scores]
    np.testing.assert_allclose(np.asarray(numbers, float), alone, rtol=2e-3)


def test_pairs_give_the_examples_of_their_captures(tmp_path):
    """Captures and truths of a folder, half of them taken by a camera with a gain."""
    physics, rng, psf = untrained().physics, np.random.default_rng(0), drawn_psf(2, SENSOR)
    camera = dataclasses.replace(CAMERA, psf=psf)
    for folder in ("captures", "truths"):
        (tmp_path / folder).mkdir()
    for number in range(3):
        recording, scene = camera.drawn(7, number)
        y, x = ((n - m) // 2 for n, m in zip(scene.shape[1:], SENSOR, strict=True))
        truth = scene[0, y : y + SENSOR[0], x : x + SENSOR[1]]
        light = np.asarray(recording.captures[0])[0] * rng.uniform(0.2, 4)
        np.save(tmp_path / "captures" / f"{number}.npy", light.astype(np.float32))
        np.save(tmp_path / "truths" / f"{number}.npy", truth)
    pairs, known = open_pairs(tmp_path), Raw(psf[0], name="psf")

    def ready(pair):
        return prepare(known, pair.capture, background=0.0, options=Preparation())

    lessons = PairLessons(pairs, ready, 1, 2)
    found = lessons.examples(physics, 0, 100)
    assert found.truth.shape == (2, 1, *SENSOR) and found.images.shape == (2, 2, 1, *SENSOR)
    for images, truth, number in zip(found.images, found.truth, (1, 2), strict=True):
        own = np.load(tmp_path / "truths" / f"{number}.npy")
        known = np.asarray(truth[0], float)
        gain, offset = np.polyfit(own.ravel(), known.ravel(), 1)
        np.testing.assert_allclose(known, gain * own + offset, atol=2e-3)  # half precision
        difference = np.asarray(images[1, 0], float) - known
        assert gain > 0 and np.mean(difference) == pytest.approx(0, abs=1e-3)
        assert np.mean(difference * known) == pytest.approx(0, abs=1e-3)


class SmallTruths(CameraLessons):
    """Examples of pairs whose truths cover a part of the sensor."""

    def examples(self, physics, seed, count):
        drawn = super().examples(physics, seed, 2)
        return jax.tree.map(lambda leaf: leaf[..., :10, :12], drawn)


def test_crops_are_no_larger_than_truths():
    small = SmallTruths(PSF, SENSOR, pictures())
    lessons = ReconstructionLessons(CAMERA, small, small, judged=1, crop=16)
    task = lessons.task(untrained().physics, 0)
    for crops in (task.draw(jax.random.key(0)), *task.validation):
        assert crops.truth.shape[-2:] == crops.images.shape[-2:] == (10, 10)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="crop = 25: give at most 24, the sensor's side"):
        ReconstructionLessons(CAMERA, crop=25)
    assert with_whole_field(CAMERA.drawn(0, 0)[0]).problem().field_shape[0] >= 36
