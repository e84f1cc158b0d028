"""A denoiser that learns inside plug and play: its captures, its steps and their gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax import learn
from thincam_jax.learn.denoiser.network import DenoiserOptions, create
from thincam_jax.learn.denoiser.pictures import drawn
from thincam_jax.learn.denoiser.reconstructions import (
    draw_cameras,
    draw_reconstructions,
    drawn_kernels,
    reconstructed,
    reconstruction_loss,
)
from thincam_jax.learn.denoiser.train import DenoisingLessons, train_denoiser
from thincam_jax.learn.training import TrainingOptions

SIDE = 24


@pytest.fixture(scope="module")
def lesson():
    tiles = jnp.asarray(drawn(0, 6).tiles)
    return draw_reconstructions(draw_cameras(3, 1, SIDE), tiles, 3, SIDE, jax.random.key(5))


def network():
    """With other last weights than zeros, so that all weights count."""
    untrained = create(DenoiserOptions((8, 8), (1, 0)), key=jax.random.key(0))
    leave = 0.02 * jax.random.normal(jax.random.key(1), untrained.leave.shape)
    other = eqx.tree_at(lambda n: n.leave, untrained, leave)
    return jax.tree.map(lambda x: x.astype(jnp.float32), other)


@pytest.mark.parametrize("captures", [1, 4])
def test_drawn_cameras_transmit_no_frequency_better_than_a_hole(captures):
    for seed in range(12):
        kernels = drawn_kernels(np.random.default_rng(seed), 61, 40.0, captures)
        response = np.sum(np.abs(np.fft.rfft2(kernels)) ** 2, axis=0) ** 0.5
        assert kernels.shape == (captures, 61, 61) and kernels.min() >= 0
        np.testing.assert_allclose([response.max(), response[0, 0]], 1, rtol=1e-5)


def test_captures_have_the_noise_that_they_say(lesson):
    (operator,), (captures,) = lesson.problem.operators, lesson.problem.captures
    clean = operator(lesson.crops.clean[:, None, None])
    noise = np.asarray(captures - clean).reshape(len(captures), -1)
    power = np.mean(noise**2, axis=1)
    assert np.all(power < 1.3 * np.asarray(lesson.variance))  # of shot noise that of the brightest
    assert np.any(power > 0.8 * np.asarray(lesson.variance))


@pytest.mark.thorough
def test_lessons_take_the_steps_of_plug_and_play(lesson):
    """With the shipped network. The solver corrects the noise given; lessons take it as it is."""
    denoiser = learn.Denoiser()
    images = reconstructed(jax.tree.map(jnp.asarray, denoiser.network), lesson)
    for n, image in enumerate(images):
        capture = lesson.problem.captures[0][n]
        told = float(lesson.variance[n])
        seen = tc.Recording(capture, lesson.problem.operators[0], noise_variance=told)
        found = tc.reconstruct(seen, tc.PlugAndPlay(denoiser)).image
        assert relative_l2(image, found.reshape(image.shape)) < 0.05


@pytest.mark.thorough
def test_the_gradient_is_that_of_differences(lesson):
    """Data steps are solved to a part of the noise, hence to a percent only."""
    net = network()
    value, slope = jax.value_and_grad(lambda n: reconstruction_loss(n, lesson)[0])(net)
    assert np.isfinite(value)
    along = jax.tree.map(lambda x: x / jnp.linalg.norm(x), slope)

    def moved(h):
        other = jax.tree.map(lambda x, d: x + h * d, net, along)
        return float(reconstruction_loss(other, lesson)[0])

    h = 4e-3  # with less, data steps of one iteration more or less show
    pairs = zip(jax.tree.leaves(slope), jax.tree.leaves(along), strict=True)
    expected = sum(float(jnp.sum(s * d)) for s, d in pairs)
    assert (moved(h) - moved(-h)) / (2 * h) == pytest.approx(expected, rel=0.02)


@pytest.mark.thorough
def test_it_learns_to_reconstruct(tmp_path):
    lessons = DenoisingLessons(drawn(0, 6), drawn(1, 6), 4, SIDE, judged=2, cameras=1)
    options = TrainingOptions(steps=40, rate=5e-3, warm_up=5, check_every=20, averaging=0.5)
    net = create(DenoiserOptions((16, 16), (1, 0)), key=jax.random.key(0))
    trained = train_denoiser(net, lessons, options, folder=tmp_path)
    before = [
        float(reconstruction_loss(jax.tree.map(jnp.asarray, net), lesson)[0])
        for lesson in lessons.task(0).validation
    ]
    assert min(trained.state.scores) < np.mean(before) - 1.0  # dB
