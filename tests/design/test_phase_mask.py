"""Reliefs found by gradient keep their limits and beat the retrieved phase at equal levels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import count_traces, finite_difference, relative_l2, value_and_slope
from thincam_jax.design import PhotonNoise, PowerLaw, Setup, SignalNoise
from thincam_jax.design.phase_mask import (
    HeightLimits,
    MaskSetting,
    cropped_error,
    linear_error,
    linear_objective,
    mask_of_phase,
    one_turn,
    refine_mask,
    restored_objective,
)
from thincam_jax.design.phase_retrieval import contour_target, match_error, retrieve_phase
from thincam_jax.design.training import TrainedSensor, Training
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.targets import siemens_star
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.masks.phase import MaskBlank
from thincam_jax.units import nm, um

GREEN, DISTANCE, PITCH = 532 * nm, 2.0, 4 * um
BLANK = MaskBlank((32, 36), PITCH, 1.5)
SENSOR = tc.Sensor((32, 36), PITCH)


def setup(pitch=PITCH, noise=None):
    return Setup(
        pitch=pitch,
        sensor_width=36 * PITCH,
        object_distance=100.0,
        object_width=5.0,
        noise=noise or SignalNoise(20.0),
        prior=PowerLaw(2.5),
    )


@pytest.fixture(scope="module")
def retrieved():
    """A target, and the mask of four levels that Gerchberg and Saxton's algorithm finds for it."""
    key = jax.random.key(4)
    target = contour_target(key, SENSOR.grid, feature=60 * um, line_width=8 * um)
    path = LightPath(GREEN, DISTANCE)
    phase = retrieve_phase(target, SENSOR.grid, path, shape=(32, 36), key=key, steps=40).phase
    limits = one_turn(BLANK, GREEN, 4)
    return target, mask_of_phase(phase, BLANK, GREEN, limits), limits


CAMERA = tc.LenslessCamera(BLANK.mask(np.zeros(BLANK.shape)), SENSOR, DISTANCE)
SETTING = MaskSetting(CAMERA, wavelengths=[GREEN])


def evaluated(objective, mask, data):
    return float(jax.jit(objective)(mask, data, jax.random.key(0)))


def test_levels_are_kept_and_derivatives_pass():
    limits = HeightLimits(3e-3, 4)
    given = jnp.asarray([[-1e-3, 0.4e-3, 0.6e-3, 2.4e-3, 2.6e-3, 9e-3]])
    np.testing.assert_allclose(limits.nearest(given), [[0, 0, 1e-3, 2e-3, 3e-3, 3e-3]], atol=1e-12)
    slope = jax.grad(lambda h: jnp.sum(limits.nearest(h)))(given)
    np.testing.assert_array_equal(slope, [[0, 1, 1, 1, 1, 0]])


def test_a_phase_becomes_the_nearest_height_up_to_whole_turns():
    """Four levels are ¼ turn apart: 0.9 turns are nearer to 1 than to ¾, and 1 is 0."""
    limits = one_turn(BLANK, GREEN, 4)
    turns = np.tile([0.0, 0.1, 0.2, 0.8, 0.9, -0.2], (2, 1))
    small = MaskBlank((2, 6), PITCH, 1.5)
    mask = mask_of_phase(jnp.asarray(2 * np.pi * turns), small, GREEN, limits)
    levels = np.asarray(mask.height) / float(BLANK.wrap_height(GREEN))
    np.testing.assert_allclose(levels[1], [0, 0, 0.25, 0.75, 0, 0.75], atol=1e-9)


@pytest.mark.parametrize("noise", [SignalNoise(20.0), PhotonNoise(5e6, 5.0)])
def test_the_linear_error_is_that_of_the_posterior(noise):
    """tr[(Σ⁻¹ + AᵀA/σ²)⁻¹]/tr Σ with dense matrices, for a cyclic blur in 5 × 6 pixels."""
    h = np.random.default_rng(1).uniform(size=(5, 6)) * 3e3
    here = setup(noise=noise)
    v, u = (np.fft.fftfreq(n, PITCH) * DISTANCE for n in (5, 6))
    prior = np.asarray(here.prior(jnp.asarray(v[:, None] ** 2 + u**2), here.field))
    basis = np.stack([np.fft.fft2(e.reshape(5, 6)).ravel() for e in np.eye(30)], 1) / np.sqrt(30)
    scene = (basis.conj().T * (prior / prior.mean() * 0.25).ravel()) @ basis
    kernel = np.stack([np.roll(h, (i, j), (0, 1)).ravel() for i in range(5) for j in range(6)], 1)
    blur = kernel * PITCH**2
    signal = np.trace(blur @ scene @ blur.T).real / 30
    variance = float(noise.variance(h.sum() * PITCH**2, signal, 1.0))
    left = np.linalg.inv(np.linalg.inv(scene) + blur.T @ blur / variance)
    found = jax.jit(linear_error)(jnp.asarray(h), here, jnp.asarray(DISTANCE))
    np.testing.assert_allclose(found, np.trace(left).real / np.trace(scene).real, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_cropped_error_is_that_of_the_posterior(dtype):
    """tr[(Σ⁻¹ + AᵀA/σ²)⁻¹]/tr Σ of a cropped convolution; with much light in float32, too."""
    field, seen = (4, 5), (7, 6)
    h = np.random.default_rng(1).uniform(size=kernel_shape(seen, field))
    here = setup(noise=PhotonNoise(1e11, 5.0))
    v, u = (np.fft.fftfreq(n, PITCH) * DISTANCE for n in field)
    prior = np.asarray(here.prior(jnp.asarray(v[:, None] ** 2 + u**2), here.field))
    each = np.eye(20).reshape(20, *field)
    basis = np.stack([np.fft.fft2(e).ravel() for e in each], 1) / np.sqrt(20)
    scene = ((basis.conj().T * (prior / prior.mean() * 0.25).ravel()) @ basis).real
    crop = CropConvolution(jnp.asarray(h), PITCH, seen, field)
    blur = np.asarray(crop(jnp.asarray(each))).reshape(20, -1).T
    variance = float(here.noise.variance(blur.sum(1).mean(), 0.0, 1.0))
    left = np.linalg.inv(np.linalg.inv(scene) + blur.T @ blur / variance)
    given = jax.tree.map(lambda a: jnp.asarray(a, dtype), (h, here, DISTANCE))
    found = jax.jit(cropped_error, static_argnums=3)(*given, field)
    np.testing.assert_allclose(found, np.trace(left) / np.trace(scene), rtol=2e-4)


@pytest.mark.thorough
def test_psfs_of_a_setting_are_the_cameras(retrieved):
    """One for each depth and wavelength; together, their mean over the wavelengths."""
    mask = retrieved[1]
    light = {"wavelengths": [450 * nm, GREEN], "object_distances": [20.0, np.inf]}
    apart = MaskSetting(CAMERA, **light)
    several = jax.jit(lambda m: apart.psfs(m))(mask)
    assert several.shape == (2, 2, 32, 36)
    camera = tc.LenslessCamera(mask, SENSOR, DISTANCE)
    of_psf = {"model": "angular_spectrum", "pixel_integration": True}
    near_blue = tc.psf(camera, wavelength=450 * nm, object_distance=20.0, **of_psf)
    assert relative_l2(several[0, 0], near_blue) < 0.05
    together = MaskSetting(CAMERA, together=True, **light)
    both = jax.jit(lambda m: together.psfs(m))(mask)
    np.testing.assert_allclose(both, several.mean(axis=1, keepdims=True), atol=1e-9)


@pytest.mark.thorough
def test_refinement_beats_the_retrieved_phase_at_equal_levels(retrieved):
    """Expected error of the best linear image of 10 × 12 samples, crop included; four levels."""
    _, mask, limits = retrieved
    key, light = jax.random.key(1), {"wavelengths": [GREEN], "field_shape": (10, 12)}
    data = MaskSetting(CAMERA, **light), setup()
    by_error = refine_mask(linear_objective, mask, limits, data, key=key, steps=40)
    step = limits.highest / 3
    off = np.asarray(by_error.mask.height) / step
    np.testing.assert_allclose(off, np.round(off), atol=1e-9)
    assert by_error.skipped == 0 and off.max() == 3
    before, after = (evaluated(linear_objective, m, data) for m in (mask, by_error.mask))
    assert after < 0.8 * before


@pytest.mark.thorough
def test_refinement_end_to_end(retrieved):
    """Through the solver: restored images, crop and noise included, come nearer to the truth."""
    _, mask, limits = retrieved
    images = np.stack([siemens_star((24, 24), spokes=n) for n in (6, 10)]) + 0.5
    training = Training(
        images,
        setup(),
        np.array([[1.0]]),
        TrainedSensor((32, 36), (DISTANCE, DISTANCE)),
        key=jax.random.key(2),
    )
    light = {"wavelengths": [GREEN], "object_distances": [100.0]}
    setting = MaskSetting(CAMERA, field_shape=training.field_shape, **light)
    data = (setting, training)
    found = refine_mask(restored_objective, mask, limits, data, key=jax.random.key(1), steps=25)
    assert found.skipped < 10  # where conjugate gradients do not reach the tolerance
    before, after = (evaluated(restored_objective, m, data) for m in (mask, found.mask))
    assert after < before


def test_gradient_and_traces():
    """Of the linear error with respect to heights; other heights and limits of light: one trace."""
    small = MaskBlank((6, 8), PITCH, 1.5)
    camera = tc.LenslessCamera(small.mask(np.zeros((6, 8))), tc.Sensor((9, 10), PITCH), 0.5)
    setting = MaskSetting(camera, wavelengths=[GREEN])
    counted = count_traces(linear_objective)
    value, slope_of = value_and_slope(
        lambda h: counted(small.mask(h), (setting, setup()), jax.random.key(0))
    )
    height = jnp.asarray(np.random.default_rng(2).uniform(0.1, 1.0, (6, 8)) * um)
    along = jnp.asarray(np.random.default_rng(3).normal(size=(6, 8))) * um
    expected = finite_difference(value, height, along, 1e-4)
    slope = slope_of(height)
    np.testing.assert_allclose(jnp.sum(slope * along), expected, rtol=1e-8)
    value(height * 1.1)
    assert counted.traces == 1


GRID = tc.Grid((64, 80), 4 * um)
PATH = LightPath(532 * nm, 2.0)


def test_contours_are_thin_lines_in_all_directions(key):
    target = np.asarray(contour_target(key, GRID, feature=80 * um, line_width=8 * um))
    np.testing.assert_allclose(target.sum(), 1, rtol=1e-6)
    lit = target > 0.5 * target.max()
    assert 0.05 < lit.mean() < 0.35
    # A line of two samples' width: nothing is left of it three samples in.
    thick = lit[:-4, :-4]
    for i, j in ((4, 0), (0, 4), (4, 4), (2, 2)):
        thick = thick & lit[i : i + thick.shape[0], j : j + thick.shape[1]]
    assert thick.mean() < 0.01
    # Its energy of gradients is shared by both axes.
    down, across = (np.mean(np.diff(target, axis=axis) ** 2) for axis in (0, 1))
    assert 0.5 < down / across < 2
    other = contour_target(jax.random.split(key)[0], GRID, feature=80 * um, line_width=8 * um)
    assert float(match_error(jnp.asarray(target), other)) > 0.5


def test_retrieval_of_a_lens(key):
    """A target of one point: the mask becomes a lens, with the peak that its aperture can have."""
    point = np.zeros(GRID.shape)
    point[20, 50] = 1.0
    found = retrieve_phase(jnp.asarray(point), GRID, PATH, shape=(40, 48), key=key, steps=3)
    blank = MaskBlank((40, 48), GRID.pitch, 1.5)
    mask = blank.mask(found.phase / (2 * np.pi) * blank.wrap_height(532 * nm))
    camera = tc.LenslessCamera(mask, tc.Sensor(GRID.shape, GRID.pitch), 2.0)
    h = tc.psf(
        camera,
        wavelength=532 * nm,
        model=tc.PsfMethod("angular_spectrum", oversampling=1),
        pixel_integration=False,
    )
    assert np.unravel_index(np.argmax(h), h.shape) == (20, 50)
    # Strehl: a perfect lens of this aperture has (ab/λf)².
    perfect = (40 * 48 * float(GRID.pitch) ** 2 / (532 * nm * 2.0)) ** 2
    assert float(h[20, 50]) > 0.93 * perfect


def test_retrieval_comes_nearer_to_contours(key):
    target = contour_target(key, GRID, feature=80 * um, line_width=8 * um)
    found = retrieve_phase(target, GRID, PATH, shape=(64, 80), key=key, steps=30)
    assert float(found.error[-1]) < 0.35 < 0.7 < float(found.error[0])
    assert 0 <= float(found.phase.min()) and float(found.phase.max()) <= 2 * np.pi
