"""A trained reconstruction: its images, its derivative, its camera and its file."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax._core.precision import AccuracyWarning
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.denoiser.network import Denoiser
from thincam_jax.learn.trained import (
    CameraPortrait,
    TrainedOptions,
    TrainedReconstruction,
    _like,
    cleaned,
    completed,
    prepared,
    training_record,
    with_whole_field,
)

OPTIONS = TrainedOptions(iterations=6, widths=(4, 6))


def drawn_psf(seed=0, shape=(14, 17)):
    """A PSF of random points, of unit sum, (1, k, l)."""
    psf = np.random.default_rng(seed).random(shape) ** 12
    return (psf / psf.sum())[None].astype(np.float32)


PSF = drawn_psf()


def recorded(channels=1, psf=PSF, seed=1):
    rng = np.random.default_rng(seed)
    scene = np.zeros((channels, 24, 32), np.float32)
    scene[:, 6:15, 8:22] = rng.uniform(0.5, 1, (channels, 1, 1))
    blank = tc.Recording(scene[None] + 1, tc.Psfs(psf[None]), background=0.0)
    problem = with_whole_field(blank).problem()
    (operator,) = problem.operators
    field = np.zeros((channels, 1, *problem.field_shape), np.float32)
    y, x = ((n - m) // 2 for n, m in zip(problem.field_shape, (24, 32), strict=True))
    field[:, 0, y : y + 24, x : x + 32] = scene
    capture = np.asarray(operator(jnp.asarray(field)))
    capture = capture + 0.01 * rng.standard_normal(capture.shape).astype(np.float32)
    return tc.Recording(capture[None], tc.Psfs(psf[None]), noise_variance=1e-4), scene


def changed(model, seed=3):
    """The model with a network that is not zero."""
    weights = 0.05 * jax.random.normal(jax.random.key(seed), model.network.leave.weight.shape)
    return eqx.tree_at(lambda m: m.network.leave.weight, model, weights)


@pytest.fixture(scope="module")
def model():
    return changed(TrainedReconstruction.create(OPTIONS, PSF, key=0))


@pytest.mark.thorough
def test_untrained_it_gives_the_image_of_its_physics_step():
    recording, scene = recorded()
    untrained = TrainedReconstruction.create(OPTIONS, PSF, key=0)
    found = tc.reconstruct(recording, untrained)
    like = tc.reconstruct(with_whole_field(recording), tc.AdmmTV(iterations=6)).image
    y, x = ((n - m) // 2 for n, m in zip(like.shape[-2:], (24, 32), strict=True))
    inside = like[..., y : y + 24, x : x + 32]
    assert found.image.shape == (1, 24, 32) and found.status == "ok" and found.method == "trained"
    np.testing.assert_allclose(found.image, inside, atol=1e-5)
    assert np.corrcoef(np.ravel(found.image), np.ravel(scene))[0, 1] > 0.8


@pytest.mark.parametrize("method", ["pnp", "both"])
def test_plug_and_play_may_be_the_physics_step(method, tmp_path):
    """Also of a file; one of a version before has none, and total variation."""
    recording, _ = recorded()
    options = dataclasses.replace(OPTIONS, method=method)
    untrained = TrainedReconstruction.create(options, PSF, key=0)
    found = tc.reconstruct(recording, untrained).image
    like = tc.reconstruct(with_whole_field(recording), tc.PlugAndPlay()).image
    y, x = ((n - m) // 2 for n, m in zip(like.shape[-2:], (24, 32), strict=True))
    inside = np.maximum(like[..., y : y + 24, x : x + 32], 0)
    np.testing.assert_allclose(found, inside, atol=1e-5)
    read = TrainedReconstruction.load(untrained.save(tmp_path / "network.thincam"))
    assert read.options == options
    known = {"iterations": 6, "colours": 1, "widths": [4, 6], "noises": 1}
    assert _like(known, {}).options == OPTIONS
    with pytest.raises(ValueError, match="method"):
        TrainedOptions(method="wiener")


def test_the_network_sees_the_images_of_both_methods():
    recording, _ = recorded()
    options = dataclasses.replace(OPTIONS, method="both")
    both = TrainedReconstruction.create(options, PSF, key=0)
    problem, images = both.physics(recording)
    seen, unit = prepared(both.physics, problem, images)
    assert seen.shape == (3, 1, 24, 32)
    for one, solver in zip(seen[1:], (tc.AdmmTV(iterations=6), tc.PlugAndPlay()), strict=True):
        like = tc.reconstruct(with_whole_field(recording), solver).image
        y, x = ((n - m) // 2 for n, m in zip(like.shape[-2:], (24, 32), strict=True))
        np.testing.assert_allclose(unit[0] * one, like[..., y : y + 24, x : x + 32], atol=1e-5)
    mended = changed(both)
    at_once = completed(mended.physics, mended.network, problem, images)
    swapped = completed(mended.physics, mended.network, problem, (images[1], images[1]))
    assert np.abs(at_once - swapped).max() > 1e-4  # the first image counts, too


def test_the_second_image_gives_back_what_the_first_one_left():
    """With the right PSF the filtered residual brings the image nearer to the capture."""
    recording, _ = recorded()
    weak = dataclasses.replace(
        TrainedReconstruction.create(OPTIONS, PSF, key=0).physics, noise=jnp.asarray([-2.0])
    )
    problem, (image,) = weak(recording)
    from thincam_jax.learn.trained import refined
    from thincam_jax.reconstruction.problem import relative_residual

    better = refined(problem, image, weak.noise)[..., None, :, :]
    assert relative_residual(problem, better) < 0.9 * relative_residual(problem, image)
    nothing = refined(problem, image, jnp.asarray([40.0]))
    np.testing.assert_allclose(nothing, image[..., 0, :, :], atol=1e-6)


def test_colours_are_seen_together_or_each_by_itself(model):
    recording, _ = recorded(3)
    alone = tc.reconstruct(recording, model).image
    assert alone.shape == (3, 24, 32)
    first = tc.Recording(
        recording.captures[0][:1][None], recording.imaging_model, noise_variance=1e-4
    )
    # The regulariser joins colours, so that their images are not quite those of each alone.
    one = tc.reconstruct(first, model).image
    assert np.corrcoef(np.ravel(one), np.ravel(alone[:1]))[0, 1] > 0.99
    options = dataclasses.replace(OPTIONS, colours=3)
    psf = np.concatenate([PSF] * 3)
    joint = changed(TrainedReconstruction.create(options, psf, key=0))
    assert joint.options == options
    images = jnp.asarray(np.random.default_rng(0).random((2, 3, 10, 13)))
    compiled = eqx.filter_jit(cleaned)
    found = compiled(joint.network, 3, images)
    moved = compiled(joint.network, 3, images.at[0, 2].add(1.0))
    assert found.shape == (3, 10, 13) and np.abs(found - moved)[0].max() > 1e-3
    apart = compiled(model.network, 1, images)
    moved = compiled(model.network, 1, images.at[0, 2].add(1.0))
    np.testing.assert_allclose(apart[:2], moved[:2], atol=1e-12)
    assert np.abs(apart - moved)[2].max() > 1e-3
    with pytest.raises(ValueError, match="has 1 colours, and the reconstruction was trained for 3"):
        tc.reconstruct(recorded()[0], joint)


def test_its_unit_is_that_of_the_image(model):
    recording, _ = recorded()
    twice = tc.Recording(2 * recording.captures[0][None], recording.imaging_model,
                         noise_variance=4e-4)  # fmt: skip
    one, two = (tc.reconstruct(r, model).image for r in (recording, twice))
    np.testing.assert_allclose(two, 2 * one, atol=1e-3 * float(one.max()))


def doubled(leaf):
    """An array in double precision."""
    kinds = {"f": jnp.float64, "c": jnp.complex128}
    return leaf.astype(kinds.get(np.dtype(leaf.dtype).kind, leaf.dtype))


def test_its_derivative_is_that_of_finite_differences(model):
    """By the noise of the Wiener filter, and by all of the network's numbers."""
    recording, scene = recorded()
    problem, image = model.physics(recording)
    problem, image = jax.tree.map(doubled, (problem, image))
    parts = jax.tree.map(lambda x: x.astype(jnp.float64), (model.physics, model.network))
    weight = jnp.asarray(np.random.default_rng(4).standard_normal((1, *problem.field_shape)))

    @eqx.filter_jit
    def value(parts):
        physics, network = parts
        return jnp.sum(weight * completed(physics, network, problem, image))

    slope = eqx.filter_grad(value)(parts)
    rng = np.random.default_rng(5)
    way = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)), parts)
    exact = sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (slope, way)), strict=True))

    def moved(step):
        return value(jax.tree.map(lambda x, w: x + step * w, parts, way))

    step = 1e-6
    assert float(exact) == pytest.approx(float(moved(step) - moved(-step)) / (2 * step), rel=1e-4)
    assert np.abs(slope[0].noise).max() > 0


def test_another_camera_is_refused_and_a_doubtful_one_told(model):
    recording, _ = recorded()
    others = (drawn_psf(9), PSF[:, ::-1], PSF[:, ::-1, ::-1])
    for other in others:
        with pytest.raises(ValueError, match="it is another camera; train for this one, or use"):
            tc.reconstruct(recorded(psf=np.ascontiguousarray(other))[0], model)
    mixed = (0.6 * PSF + 0.4 * drawn_psf(9)).astype(np.float32)
    with pytest.warns(AccuracyWarning, match="train anew if the camera was changed"):
        found = tc.reconstruct(recorded(psf=mixed)[0], model)
    assert "correlates by 0." in found.reason
    wide = np.pad(PSF, ((0, 0), (2, 2), (2, 2)))
    with pytest.raises(
        ValueError, match="the PSF has 18×21 pixels, and that of the training 14×17"
    ):
        tc.reconstruct(recorded(psf=wide)[0], model)
    several = tc.Recording(np.ones((2, 24, 32)), tc.Psfs(np.stack([PSF[0]] * 2)))
    with pytest.raises(ValueError, match="one capture by a measured PSF"):
        tc.reconstruct(several, model)
    assert tc.reconstruct(recording, model).reason == ""


def test_a_portrait_knows_its_camera_again():
    psf = np.zeros((1, 90, 130), np.float32)
    psf[0, 20:70, 20:110] = np.random.default_rng(0).random((50, 90)) ** 12
    portrait = CameraPortrait.of(psf)
    assert portrait.fit(psf) == 1 and max(portrait.image.shape) <= 64
    assert portrait.fit(3 * psf) == pytest.approx(1, abs=1e-5)  # in other units
    assert portrait.fit(np.roll(psf, (6, -6), axis=(1, 2))) > 0.95
    assert portrait.fit(np.roll(psf, 45, axis=2)) < 0.6
    assert portrait.fit(psf[:, :80]) == 0


def test_a_file_holds_all_and_is_read_whole_or_not_at_all(model, tmp_path):
    path = tmp_path / "network.thincam"
    model.save(path, {"scores": [0.25]})
    assert training_record(path) == {"scores": [0.25]}
    read = TrainedReconstruction.load(path)
    assert read.options == OPTIONS and read.camera is not None
    assert read.camera.digest == model.camera.digest
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), model)
    assert eqx.tree_equal(read, single)
    recording, _ = recorded()
    one, two = (tc.reconstruct(recording, m).image for m in (model, read))
    np.testing.assert_allclose(one, two, atol=1e-5)

    content = path.read_bytes()
    for damaged in (content[:-1], content[:-40] + b"?" + content[-39:], content[:200]):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError) as caught:
            TrainedReconstruction.load(path)
        assert "\n" not in str(caught.value)
    Denoiser().save(path)
    with pytest.raises(CheckpointError, match="holds no trained reconstruction"):
        TrainedReconstruction.load(path)


def test_sizes_out_of_range_are_refused():
    with pytest.raises(ValueError, match="give 1 to 8 levels"):
        TrainedOptions(widths=())
    with pytest.raises(ValueError, match="iterations"):
        TrainedOptions(iterations=0)
    recording, _ = recorded()
    physics = TrainedReconstruction.create(OPTIONS, PSF, key=0).physics
    images, unit = prepared(physics, *physics(recording))
    assert images.shape == (2, 1, 24, 32) and unit.shape == (1, 1, 1)
