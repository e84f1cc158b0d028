"""Joint reconstruction of several planes from one set of captures."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage as ndimage
import scipy.signal as signal
from reconstruction.depth import rig

import thincam_jax as tc
from thincam_jax.lensless.method import AccuracyWarning
from thincam_jax.reconstruction import fringe_scanning
from thincam_jax.reconstruction.depth import find_distances, refocus_sweep
from thincam_jax.reconstruction.planes import (
    with_equal_planes,
    with_smooth_light,
    without_smooth_misfit,
)
from thincam_jax.reconstruction.problem import misfit

PLANES = (20.0, 45.0, 150.0)


@pytest.fixture(scope="module")
def seen():
    cams = rig.cameras()
    planes = [rig.plane(i, t) for i, t in zip(rig.shapes(), PLANES, strict=True)]
    return cams, rig.captures(cams, planes, snr_db=30.0)


def reconstruct(seen, planes=PLANES, **settings):
    cams, captures = seen
    recording = tc.Recording(captures, rig.imaging_model(cams, object_distance=list(planes)))
    return tc.reconstruct(recording, tc.AdmmTV(1.0, synthesis=fringe_scanning(1), **settings))


def shares(image, power):
    """Σ f^power of each object in its own plane, over that in all planes at its directions."""
    found = []
    for own, shape in enumerate(rig.shapes()):
        around = ndimage.binary_dilation(shape > 0, iterations=3)
        light = (np.maximum(image, 0) ** power)[:, around].sum(axis=1)
        found.append(light[own] / light.sum())
    return np.array(found)


@pytest.mark.thorough
def test_each_object_is_in_its_own_plane(seen):
    """Four phases, 30 dB, f ≥ 0 on black: over 90 % of the light, over 99 % of the energy."""
    result = reconstruct(seen, iterations=150)
    image = np.asarray(result.image)
    assert image.shape == (3, *rig.FIELD)
    assert shares(image, 1).min() > 0.9
    assert shares(image, 2).min() > 0.99
    # Nothing to speak of lies beside the objects, and the objects are the right ones.
    around = ndimage.binary_dilation(rig.shapes().max(axis=0) > 0, iterations=3)
    assert image[:, ~around].sum() < 0.05 * image.sum()
    errors = np.linalg.norm(image - rig.shapes(), axis=(1, 2))
    assert (errors < 0.4 * np.linalg.norm(rig.shapes(), axis=(1, 2))).all()
    np.testing.assert_allclose(
        result.pitch, np.array(PLANES) * rig.PITCH / rig.DISTANCE, rtol=1e-12
    )


def measured(step, near, *, brightness=(1.0, 1.0), planes=4, noise=0.005):
    """A chequered object in plane `near` of a diffuser's, or images of all planes: its recording.

    PSFs shrink by `step` pixels at their edge from plane to plane, and are as bright as linearly
    between the ends of `brightness`.
    """
    rng = np.random.default_rng(3)
    y, x = (np.arange(n) - (n - 1) / 2 for n in rig.FIELD)
    spots, powers = rng.uniform(-0.42, 0.42, (60, 2)) * rig.FIELD, rng.exponential(1, 60)
    psfs = []
    for number, bright in enumerate(np.linspace(*brightness, num=planes)):
        scale = 1 - number * step / (0.42 * rig.FIELD[1])
        rows, columns = (
            np.exp(-((axis[:, None] / scale - spots[:, k]) ** 2) / 3)
            for k, axis in enumerate((y, x))
        )
        psf = (rows * powers) @ columns.T
        psfs.append(bright * psf / psf.sum())
    if np.ndim(near) == 0:
        images = np.zeros((planes, *rig.FIELD))
        images[near] = rig.checks(np.s_[14:34, 14:42], 6)
    else:
        images = near
    pairs = zip(images, psfs, strict=True)
    capture = sum(signal.fftconvolve(image, psf, mode="same") for image, psf in pairs)
    capture += noise * capture.max() * rng.normal(size=rig.FIELD)
    return tc.Recording(capture[None], tc.Psfs(np.stack(psfs)[None, None]))


@pytest.mark.thorough
@pytest.mark.parametrize("brightness", [(1.0, 1.0), (1.0, 2.0), (2.0, 1.0)])
def test_a_near_object_stays_near(brightness):
    """No plane draws light for a brighter PSF, and 100 iterations suffice."""
    image = tc.reconstruct(measured(2.0, 0, brightness=brightness), tc.AdmmTV()).image
    light = np.asarray(image).sum(axis=(1, 2))
    assert light[0] > 0.85 * light.sum()
    assert light[3] < 0.05 * light.sum()


def on_a_pedestal(recording, size):
    """PSFs measured in uniform light, of `size` times their mean."""
    psfs = np.asarray(recording.imaging_model.psfs)
    psfs = psfs + size * psfs.mean(axis=(-2, -1), keepdims=True)
    return replace(recording, imaging_model=tc.Psfs(psfs))


@pytest.mark.thorough
def test_a_pedestal_of_the_psfs_moves_no_light_to_the_far_plane():
    """39 % stayed: a smaller shadow explained that the rest of the sensor is dark."""
    recording = measured(1.0, 0, planes=2)
    for size in (0.0, 0.2):
        image = tc.reconstruct(on_a_pedestal(recording, size), tc.AdmmTV()).image
        light = np.asarray(image).sum(axis=(1, 2))
        assert light[0] > 0.8 * light.sum()


def test_smooth_misfit_counts_less_where_it_exceeds_the_noise():
    """The true image explains captures to some noise in spite of a pedestal; noisy ones stay."""
    bright = on_a_pedestal(measured(2.0, 0, planes=2), 0.2).problem()
    rows, columns = bright.image_shape[-2:]
    image = np.zeros(bright.image_shape)
    top, left = (rows - rig.FIELD[0] + 1) // 2, (columns - rig.FIELD[1] + 1) // 2
    image[0, 0, top : top + rig.FIELD[0], left : left + rig.FIELD[1]] = rig.checks(
        np.s_[14:34, 14:42], 6
    )
    filtered = without_smooth_misfit(bright)
    image = jnp.asarray(image)
    assert misfit(filtered, image) < 0.01 * misfit(bright, image)
    noisy = measured(2.0, 0, planes=2, noise=0.03).problem()
    assert without_smooth_misfit(noisy) is noisy


def test_light_that_fills_planes_keeps_its_low_frequencies_through_right_psfs():
    """Through right PSFs errors fall by a fifth; through those on a pedestal the image stays."""
    y, x = np.indices(rig.FIELD)
    near = 0.5 + 0.5 * np.sin(y / 7) * np.cos(x / 9)
    scene = np.stack([near * (x < 26), (0.3 + 0.7 * y / y.max()) * (x >= 26)])
    right = measured(2.0, scene, planes=2, noise=0.002)
    for recording in (right, on_a_pedestal(right, 0.2)):
        problem, _ = with_equal_planes(recording.problem())

        def minimise(image, iterations, problem=problem):
            return tc.AdmmTV(iterations=iterations).minimise(problem, image, None, given=True)

        start = jnp.zeros(problem.image_shape)
        first = minimise(start, 150, without_smooth_misfit(problem))
        found = with_smooth_light(problem, first, minimise, 150)
        if recording is right:
            before, after = (
                np.asarray(recording.reconstruction(one, "", 2.0).image) for one in (first, found)
            )
            errors = (np.linalg.norm(one - scene, axis=(1, 2)) for one in (before, after))
            assert (np.divide(*errors) > 1.2).all()
            assert found.iterations > 100 and found.history[-1].iteration == found.iterations
        else:
            np.testing.assert_array_equal(found.image, first.image)


SOLVERS = [
    tc.AdmmTV(iterations=1),
    tc.Fista(iterations=1),
    tc.PoissonTV(iterations=1),
    tc.Ridge(0.1),
    tc.PlugAndPlay(lambda image, sigma: image, iterations=1),
]


@pytest.mark.thorough
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: solver.name)
def test_planes_that_are_alike_are_named_once(solver, recwarn):
    alike, apart = (
        replace(one, captures=np.maximum(one.captures, 0))
        for one in (measured(0.2, 0), measured(2.0, 0))
    )
    tc.reconstruct(apart, solver)
    assert not recwarn
    with pytest.warns(AccuracyWarning, match="planes . and . of 4 .* by 0.99.*sweep") as told:
        tc.reconstruct(alike, solver)
    assert len(told) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("near", [1, 4, 7])
def test_the_sweep_that_the_warning_names_finds_the_plane(near):
    recording = measured(0.5, near, planes=9)
    with pytest.warns(AccuracyWarning, match="use thincam_jax.reconstruction.depth.refocus_sweep"):
        tc.reconstruct(recording, tc.AdmmTV(iterations=1))
    distances = 1 / np.linspace(1, 0.2, 9)
    found = find_distances(refocus_sweep(recording, distances, tc.AdmmTV(iterations=50)))
    place = np.interp(
        1 / found.distance_of(1).distance, np.linspace(0.2, 1, 9), np.arange(8, -1, -1)
    )
    assert abs(place - near) < 1
