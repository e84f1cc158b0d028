"""Slightly wrong PSFs and cameras are mended from captures; what these do not tell is left."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import thincam_jax as tc
from thincam_jax.reconstruction.refinement import _block, _moved, _Search, _unknowns, changed_psf
from thincam_jax.units import nm, um

SHAPE = (48, 64)


def spots(*, scale=1.0, turn=0.0, shift=(0.0, 0.0), seed=0, size=1):
    """Gaussian spots, turned anticlockwise (y points down), of unit sum; `size` times as large."""
    generator, shape = np.random.default_rng(seed), [size * n for n in SHAPE]
    y, x = (generator.uniform(-0.3, 0.3, 40) * n * scale for n in shape)
    y, x = y * np.cos(turn) - x * np.sin(turn), y * np.sin(turn) + x * np.cos(turn)
    width = 1.2 * scale * size
    rows, columns = (
        np.exp(-((np.arange(n)[:, None] - (n - 1) / 2 - place - move) ** 2) / (2 * width**2))
        for n, place, move in zip(shape, (y, x), shift, strict=True)
    )
    psf = (rows * generator.exponential(1, 40)) @ columns.T
    return psf / psf.sum()


def scene(seed):
    """Rectangles on black."""
    generator = np.random.default_rng(seed)
    image = np.zeros([2 * n - 1 for n in SHAPE])
    for _ in range(25):
        top, left = (n // 2 + generator.integers(0, n - 8) for n in SHAPE)
        height, width = generator.integers(3, 14, 2)
        image[top : top + height, left : left + width] = generator.uniform(0.1, 1)
    return image


def seen(psfs, seed=1):
    """Captures of a scene, with noise and an unknown background."""
    operators = tc.Recording(np.ones(psfs.shape), tc.Psfs(psfs)).problem().operators
    image = np.kron(scene(seed), np.ones([psfs.shape[-1] // SHAPE[1]] * 2))
    rows, columns = operators[0].field_shape
    image = np.pad(image, [(0, rows - len(image)), (0, columns - len(image[0]))])
    clean = np.stack([np.asarray(o(jnp.asarray(image[None, None])))[0] for o in operators])
    noise = 0.01 * clean.std() * np.random.default_rng(seed).normal(size=clean.shape)
    return clean + 0.1 * clean.max() + noise


@pytest.fixture(scope="module")
def capture():
    return seen(spots()[None])


@pytest.mark.thorough
def test_scale_and_turn_are_mended(capture):
    wrong = spots(scale=0.97, turn=-0.009)
    counted = []
    recording = tc.Recording(capture, tc.Psfs(wrong[None]))
    found = tc.refine(recording, parameters=("scale", "turn"), callback=counted.append)
    assert found.is_changed and not found.undetermined
    assert found.noise_ratio < 0.9 * found.noise_ratio_before
    for name, value in (("scale", 1 / 0.97), ("turn", 0.009)):
        assert abs(found.values[name] - value) < 3 * found.errors[name] < 0.01
    assert counted == list(range(2, 2 * len(counted) + 2, 2))
    assert f"turn {found.values['turn']:.5g} ± " in str(found) and " rad" in str(found)
    held_out = replace(recording, captures=seen(spots()[None], seed=2))
    better = replace(held_out, imaging_model=found.recording.imaging_model)
    before, after = (
        _Search(r, 0.5, [], None).residual(np.empty(0), None, 400) for r in (held_out, better)
    )
    assert np.sum(after**2) < 0.8 * np.sum(before**2)


@pytest.mark.thorough
def test_large_captures_are_refined_on_blocks_of_pixels():
    """The numbers are in pixels of the captures."""
    right, wrong = spots(size=4), spots(size=4, scale=0.98, turn=-0.006)
    recording = tc.Recording(seen(right[None]), tc.Psfs(wrong[None]))
    assert _Search(recording, 0.5, [], None, _block(recording)).captures[0].shape == (1, 96, 128)
    found = tc.refine(recording)
    for name, value in (("scale", 1 / 0.98), ("turn", 0.006)):
        assert abs(found.values[name] - value) < 3 * found.errors[name] < 0.01
    better = found.recording.imaging_model.psfs[0, 0, 0]
    assert np.linalg.norm(better - right) < 0.2 * np.linalg.norm(wrong - right)


@pytest.mark.thorough
def test_a_right_psf_stays(capture):
    recording = tc.Recording(capture, tc.Psfs(spots()[None]))
    found = tc.refine(recording)
    assert not found.is_changed and found.recording is recording
    assert abs(found.values["scale"] - 1) < 3 * found.errors["scale"] < 0.01
    assert set(found.undetermined) >= {"shift"}
    assert str(found).endswith("unchanged")


@pytest.mark.thorough
def test_shifts_between_psfs_are_mended():
    right = [spots(), spots(seed=1)]
    wrong = [spots(), spots(seed=1, shift=(-0.6, 0.8))]
    recording = tc.Recording(seen(np.stack(right)), tc.Psfs(np.stack(wrong)))
    found = tc.refine(recording, parameters=["shift"])
    for axis, value in (("y", 0.6), ("x", -0.8)):
        name = f"shift_{axis} 2"
        assert abs(found.values[name] - value) < max(3 * found.errors[name], 0.05)
        assert found.units[name] == "pixels"


@pytest.mark.thorough
def test_a_camera_from_afar_tells_no_object_distance():
    one = tc.LenslessCamera(
        tc.FresnelZoneAperture(30.0, width=1.0), tc.Sensor((32, 40), 40 * um), 3.0
    )
    optics = tc.Cameras([one], wavelength=500 * nm, object_distance=1e4)
    recording = tc.Recording(np.ones((1, 32, 40)), optics, noise_variance=1.0)
    found = tc.refine(recording, parameters=["object_distance"])
    assert found.undetermined == {"object_distance": "the PSF hardly depends on it"}
    endless = replace(recording, imaging_model=replace(optics, object_distance=np.inf))
    found = tc.refine(endless, parameters=["object_distance"])
    assert found.undetermined == {"object_distance": "it is infinite"}


def test_blocks_leave_enough_pixels_and_detail():
    grain = np.random.default_rng(0).random((1, 192, 256))
    sizes = (spots(size=4)[None], 2), (grain, 1), (spots(size=4)[None, :80], 1), (spots()[None], 1)
    for psf, size in sizes:
        recording = tc.Recording(np.ones(psf.shape), tc.Psfs(psf), noise_variance=1.0)
        assert _block(recording) == size


def test_changed_psfs_are_those_of_the_pattern():
    changed = {"scale": 1.03, "turn": 0.02}
    shift = (0.4, -0.7)
    wanted = spots(scale=1.03, turn=0.02, shift=shift)
    np.testing.assert_allclose(changed_psf(spots(), changed, shift), wanted, atol=2e-4)
    blurred = changed_psf(spots(), {"blur": 0.7})
    wanted = scipy.ndimage.gaussian_filter(spots(), np.sqrt(0.7), mode="wrap", truncate=8)
    np.testing.assert_allclose(blurred, wanted, atol=1e-5)
    np.testing.assert_allclose(changed_psf(blurred, {"blur": -0.7}), spots(), atol=1e-6)
    assert blurred.sum() == pytest.approx(1.0)


@pytest.mark.thorough
def test_slopes_are_those_of_the_misfit_by_differences(capture):
    """Of the misfit of hidden pixels, with the image's response."""
    psfs = tc.Psfs(spots(scale=0.99, turn=-0.01)[None])
    unknowns, _ = _unknowns(psfs, ("scale", "turn"), 0.06)
    search = _Search(tc.Recording(capture, psfs), 0.5, unknowns, None)
    search.residual(search.given, None, 400)
    images = search.images
    residual = search.residual(search.given, images, 60)
    search.__dict__["steps"] = search.steps / 8
    found = search._slopes(search.given, [0, 1], images) @ residual.ravel()
    for k, step in enumerate(search.steps / 2):
        moved = [search.given + sign * step * np.eye(2)[k] for sign in (1, -1)]
        above, below = (np.sum(search.residual(m, images, 60) ** 2) / 2 for m in moved)
        wanted = (above - below) / (2 * step)
        assert found[k] == pytest.approx(wanted, rel=0.1, abs=0.02 * np.abs(found).max())


def test_what_cannot_be_refined_is_said():
    small = tc.Recording(np.ones((1, 20, 40)), tc.Psfs(np.eye(9)[None]))
    with pytest.raises(ValueError, match="give at least 32 a side"):
        tc.refine(small)
    with pytest.raises(ValueError, match="give a recording with tc.Psfs"):
        tc.refine(tc.Recording(small.captures[0], small.problem().operators[0], noise_variance=1.0))
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda g: tc.refine(tc.Recording(g, tc.Psfs(np.eye(9)[None]))))(
            np.ones((1, 32, 40))
        )


def test_distances_move_together():
    cameras = [
        tc.LenslessCamera(tc.FresnelZoneAperture(30.0, width=1.0), tc.Sensor((32, 40), 40 * um), d)
        for d in (2.0, 3.0)
    ]
    optics = tc.Cameras(cameras, wavelength=500 * nm, object_distance=[50.0, 100.0])
    unknowns, _ = _unknowns(optics, ("distance", "object_distance"), 0.05)
    assert [(u.given, u.search) for u in unknowns] == [(3.0, 0.05 * 3), (50.0, 0.05 * 50)]
    moved = _moved(optics, {"distance": 3.3, "object_distance": 55.0})
    assert isinstance(moved, tc.Cameras)
    np.testing.assert_allclose([c.distance for c in moved.cameras], [2.2, 3.3], rtol=1e-6)
    np.testing.assert_allclose(moved.object_distance, [55.0, 110.0])
