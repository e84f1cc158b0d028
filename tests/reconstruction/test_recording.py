"""From what was seen to problems, registered and weighted, and from outcomes to results."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig
from scipy import signal

import thincam_jax as tc
from helpers import quick
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable, Stacked
from thincam_jax.reconstruction import InverseProblem
from thincam_jax.reconstruction.iterate import Outcome
from thincam_jax.reconstruction.problem import residuals, total_misfit

SENSOR, FIELD = tc.Sensor((52, 61), rig.SENSOR.pitch), (28, 33)
RNG = np.random.default_rng(8)
compiled_residuals = jax.jit(residuals)


def cameras(count=2, **settings):
    return rig.phases(count, sensor=SENSOR, width=1.2, **settings)


def camera_problem(captures, lenses, *, synthesis=None, noise_variance=None, valid=None, **light):
    """The problem of captures by cameras in the light of `rig.scene`."""
    imaging_model = rig.imaging_model(lenses, **({"field_shape": FIELD} | light))
    recording = tc.Recording(captures, imaging_model, noise_variance=noise_variance, valid=valid)
    return recording.problem(synthesis=synthesis)


def psf_problem(captures, psfs, *, field_shape=None, tau=2.0, **known):
    """The problem of captures with measured PSFs."""
    imaging_model = tc.Psfs(psfs, field_shape=field_shape)
    return tc.Recording(captures, imaging_model, background=0.0, **known).problem(tau=tau)


def projected(image) -> jax.Array:
    """The scene turned over, as a field (channel, plane, y, x)."""
    return jnp.asarray(np.asarray(image)[None, None, ::-1, ::-1].copy())


def share(problem, image) -> list[float]:
    """‖√w (Hf − g)‖ / ‖√w g‖ of each capture."""
    gaps = compiled_residuals(problem, image)
    parts = jax.device_get((gaps, problem.captures, problem.weights))
    return [
        float(np.linalg.norm(np.sqrt(w) * r) / np.linalg.norm(np.sqrt(w) * g))
        for r, g, w in zip(*parts, strict=True)
    ]


def test_the_scene_explains_its_captures():
    """The image projected on the sensor through the operators is what `capture` says."""
    image = rig.picture(FIELD)
    seen = rig.captures(cameras(), image)
    problem = camera_problem(seen, cameras())
    assert problem.field_shape == FIELD and len(problem.operators) == 2
    assert max(share(problem, projected(image))) < 1e-6
    assert min(share(problem, projected(image[::-1]))) > 0.02


def test_sums_of_captures_take_sums_of_kernels():
    """Differences of opposite phases: the residual of the scene vanishes, variances add."""
    image = rig.picture(FIELD)
    rigs = cameras(4)
    seen = rig.captures(rigs, image)
    rows = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 2.0, 0.0, -2.0]])
    problem = camera_problem(seen, rigs, synthesis=rows, noise_variance=[1.0, 2, 3, 4])
    assert max(share(problem, projected(image))) < 1e-6
    np.testing.assert_allclose(problem.captures[1][0], 2 * (seen[1] - seen[3]), rtol=1e-12)
    for weight, variance in zip(problem.weights, (1 + 3, 4 * (2 + 4)), strict=True):
        np.testing.assert_allclose(weight, 1 / variance, rtol=1e-12)


@pytest.mark.thorough
def test_an_invalid_pixel_taints_what_is_interpolated_from_it():
    """What an invalid pixel changes by more than a hundredth of itself has no weight."""
    rigs = cameras(1, distance=3.0) + cameras(1, distance=2.4)
    seen = rig.captures(rigs, rig.picture(FIELD))
    valid = np.ones(seen.shape, bool)
    valid[1, 20, 30] = valid[0, 7, 9] = False
    bright = seen.at[1, 20, 30].add(1.0).at[0, 7, 9].add(1.0)
    clean, spoilt = (camera_problem(s, rigs, valid=valid) for s in (seen, bright))
    for k in (0, 1):
        change = np.abs(np.asarray(spoilt.captures[k] - clean.captures[k]))
        trusted = np.asarray(clean.weights[k]) > 0
        assert change.max() > 0.5 and change[trusted].max() < 0.011
    first = np.asarray(clean.weights[0])[0]
    assert first[7, 9] == 0 and (first == 0).sum() == 1


def test_what_is_invalid_need_not_be_a_number():
    seen = rig.captures(cameras(), rig.picture(FIELD))
    broken = np.asarray(seen) + 1e-3 * RNG.normal(size=seen.shape)
    valid = np.ones(seen.shape, bool)
    valid[0, 3, 4] = valid[1, 20, 21] = False
    broken[0, 3, 4], broken[1, 20, 21] = np.nan, np.inf
    for problem in (
        camera_problem(broken, cameras(), valid=valid),
        psf_problem(broken, broken[:, 30:39, 30:41], valid=valid),
    ):
        for leaf in jax.tree.leaves(problem):
            assert np.isfinite(leaf).all()
        assert [int((np.asarray(w) == 0).sum()) for w in problem.weights] == [1, 1]


def test_planes_at_several_distances():
    """Two planes in the scene and in the field; exchanged, they do not explain the capture."""
    front, back = rig.picture(FIELD), rig.picture(FIELD)[::-1] * 0.7
    distances = (60.0, 160.0)
    planes = [
        tc.ImagePlane(image, t, float(SENSOR.pitch) * t / 3.0 * FIELD[1])
        for image, t in zip((front, back), distances, strict=True)
    ]
    view = tc.Scene(planes, rig.WAVELENGTH)
    seen = jnp.stack(
        [tc.capture(c, view, model="geometric", pixel_integration=False) for c in cameras()]
    )
    problem = camera_problem(seen, cameras(), object_distance=distances)
    assert problem.image_shape == (1, 2, *FIELD)
    both = jnp.concatenate([projected(front), projected(back)], axis=1)
    assert max(share(problem, both)) < 1e-6
    assert min(share(problem, both[:, ::-1])) > 1e-3
    np.testing.assert_allclose(
        rig.imaging_model(cameras(), object_distance=jnp.asarray(distances)).pitch,
        SENSOR.pitch * np.array(distances) / 3.0,
    )


@pytest.mark.parametrize(
    ("kernel", "sensor"),
    quick(
        itertools.product(
            [(5, 8), (7, 7), (12, 17), (13, 19), (29, 30), (40, 61)], [(12, 17), (13, 11)]
        ),
        *(1, 11),
    ),
)
def test_measured_psfs_of_any_size(sensor, kernel):
    """Smaller, larger, odd, even, prime: by scipy's convolution of a field with the PSF.

    The field's middle falls on the sensor's; its samples that send light to the sensor are all in.
    """
    psf, capture = RNG.uniform(size=kernel), RNG.uniform(size=sensor)
    problem = psf_problem(capture[None], psf[None])
    assert problem.field_shape == tuple(s + k - 1 for s, k in zip(sensor, kernel, strict=True))
    image = RNG.normal(size=problem.field_shape)
    expected = signal.fftconvolve(image, psf, mode="full")
    corner = [k - 1 for k in kernel]
    expected = expected[corner[0] :, corner[1] :][: sensor[0], : sensor[1]]
    value = np.asarray(compiled_residuals(problem, image[None, None])[0]) + capture
    np.testing.assert_allclose(value[0], expected, atol=1e-10 * np.abs(expected).max())


def test_a_field_that_is_given_is_smaller_by_one_at_most():
    """Its centre must lie on that of the samples; a point in its middle gives the PSF's middle."""
    psf, field = RNG.uniform(size=(5, 8)), (10, 9)
    problem = psf_problem(np.ones((1, 12, 17)), psf[None], field_shape=field)
    shape = problem.field_shape
    assert all(0 <= a - b <= 1 for a, b in zip(field, shape, strict=True))
    image = RNG.normal(size=shape)
    full = signal.fftconvolve(image, psf, mode="full")  # its middle is the sensor's
    whole = np.zeros((12, 17))
    top, left = ((s - f) // 2 for s, f in zip((12, 17), full.shape, strict=True))
    expected = whole.copy()
    rows = slice(max(top, 0), max(top, 0) + min(full.shape[0], 12))
    columns = slice(max(left, 0), max(left, 0) + min(full.shape[1], 17))
    expected[rows, columns] = full[
        max(-top, 0) : max(-top, 0) + 12, max(-left, 0) : max(-left, 0) + 17
    ]
    value = np.asarray(compiled_residuals(problem, image[None, None])[0]) + 1.0
    np.testing.assert_allclose(value[0], expected, atol=1e-10)


@pytest.mark.parametrize("channels", quick([1, 3, 7], 1))
def test_channels_and_planes_of_psfs(channels):
    """One PSF for all channels, one each, planes of each: every channel by its own convolution."""
    captures = RNG.uniform(size=(2, channels, 9, 8))
    for shape in ((2, 4, 5), (2, channels, 4, 5), (2, channels, 3, 4, 5)):
        psfs = RNG.uniform(size=shape)
        problem = psf_problem(captures, psfs)
        planes = 3 if len(shape) == 5 else 1
        assert problem.image_shape == (channels, planes, 12, 12)
        image = RNG.normal(size=problem.image_shape)
        table = psfs.reshape(2, *shape[1:-2], *(1,) * (5 - len(shape)), *shape[-2:])
        for k, gap in enumerate(compiled_residuals(problem, image)):
            for c in range(channels):
                kernels = table[k, min(c, table.shape[1] - 1)]
                expected = sum(
                    signal.convolve(image[c, p], kernels[p], mode="valid") for p in range(planes)
                )
                np.testing.assert_allclose(
                    np.asarray(gap)[c] + captures[k, c], expected, atol=1e-12
                )


def test_tau_is_the_noise_of_the_back_projection():
    """τ = 1 is the standard deviation of Σ Hᵀn/σ² at a pixel, over draws of noise."""
    sizes = (0.4, 1.5)
    shape = (30, 31)
    kernels = [RNG.normal(size=(1, 2, 7, 6)), RNG.uniform(size=(1, 2, 7, 6))]
    field = (20, 20)
    window = (64, 64)
    operators = [
        CropConvolution(jnp.asarray(k), 0.5, shape, field, summed=1, window=window) for k in kernels
    ]
    noise = [s * jnp.asarray(RNG.normal(size=(200, 1, *shape))) for s in sizes]
    back = sum(o.adjoint(n / s**2) for o, n, s in zip(operators, noise, sizes, strict=True))
    middle = back[..., 6:-6, 6:-6]  # where the whole PSF falls on the sensor
    expected = math.sqrt(float(jnp.mean(middle**2)))
    weights = [1 / s**2 for s in sizes]
    captures = [jnp.zeros((1, *shape)) for _ in sizes]
    value = InverseProblem(operators, captures, weights=weights, tau=1.0).absolute_tau
    assert float(value) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("shape", [(), (61,), (52, 61), (1, 52, 61), (2, 52, 61), (2, 1, 52, 61)])
def test_masks_of_any_shape_that_fits_say_the_same(shape):
    """One for all captures or one for each; of a grey capture, or of each of its colours."""
    colours = (1,) if len(shape) == 4 else ()
    seen = RNG.uniform(size=(2, *colours, *SENSOR.shape))
    mask = np.ones(shape, bool)
    if shape:
        mask[..., 30] = False
    problem = psf_problem(seen, np.ones((2, 4, 5)), valid=mask, noise_variance=0.5)
    expected = np.ones((1, *SENSOR.shape))
    expected[..., 30] = not shape
    for weight in problem.weights:
        np.testing.assert_allclose(weight, 2.0 * expected)


def matrix(pixels, seed=3):
    """A dense operator on images of 4×5 pixels."""
    table = np.random.default_rng(seed).uniform(size=(pixels, 20))
    return Matrix(table, (4, 5), (pixels,))


def test_operators_with_captures_of_any_shape():
    """Of one and of several; colours and batches keep their axes, and PSFs have no pitch."""
    one, two = matrix(30), Separable(np.ones((6, 4)), np.ones((7, 5)))
    for batch in ((), (3,), (2, 3)):
        taken = [np.ones((*batch, 30)), np.ones((*batch, 6, 7))]
        for captures, imaging_model in (
            (taken[0], one),
            ([taken[0]], [one]),
            (taken, [one, two]),
            (taken, Stacked([one, two])),
            ([taken[0], taken], [one, Stacked([one, two])]),
        ):
            recording = tc.Recording(captures, imaging_model, noise_variance=1.0)
            problem = recording.problem()
            assert problem.image_shape == (*(batch or (1,)), 1, 4, 5)
            image = jax.device_put(RNG.uniform(size=problem.image_shape))
            outcome = Outcome(image, "converged", (), 1, 0.0)
            result = recording.reconstruction(outcome, "admm_tv")
            np.testing.assert_array_equal(result.image, np.reshape(image, (*batch, 4, 5)))
            assert result.pitch is None


def test_the_constructor_refuses_what_no_method_takes():
    """Before a method is chosen: channels that differ, and a noise variance that is none."""
    seen, psfs = np.ones((1, 3, 9, 12)), tc.Psfs(np.ones((1, 2, 7, 5)))
    with pytest.raises(ValueError, match="3 channels and its PSF 2; give a PSF of 1 channel"):
        tc.Recording(seen, psfs)
    for variance, message in (("a", "give an array of real numbers"), (math.nan, "not finite")):
        with pytest.raises((TypeError, ValueError), match=message):
            tc.Recording(seen[:, :2], psfs, noise_variance=variance)


def test_what_cameras_refuse():
    seen, two = jnp.ones((2, *SENSOR.shape)), cameras()
    for captures, settings, message in (
        (seen[:, 3:], {}, r"captures have \(49, 61\) pixels, the cameras' sensor \(52, 61\)"),
        (seen[:1], {}, r"captures have shape \(1, 52, 61\) for 2 cameras"),
        (seen, {"object_distance": None}, "the Cameras have no object_distance; give it in mm"),
    ):
        rig.refused(message, lambda c=captures, s=settings: camera_problem(c, two, **s))


def test_what_has_seen_the_captures_is_one_of_three():
    seen = jnp.ones((2, *SENSOR.shape))
    for value, message in (
        (cameras(), r"does not say in which light; give tc.Cameras\(cameras, wavelength="),
        (
            jnp.ones((2, 4, 5)),
            r"imaging_model is a ArrayImpl; give tc.Cameras\(…\), tc.Psfs\(…\), or",
        ),
        ([matrix(30), 3], "imaging_model holds objects that are no operators"),
    ):
        rig.refused(message, lambda v=value: tc.Recording(seen, v), TypeError)
    rig.refused("operators is empty", lambda: tc.Recording(seen, []))
    one, two = [jnp.ones(30)], [matrix(30)] * 2
    rig.refused(r"captures have shape \[\(30,\)\] for 2 c", lambda: tc.Recording(one, two))
    vectors = tc.Recording(jnp.ones(30), matrix(30))
    rig.refused("give noise_variance: it is estimated from captures", vectors.problem)
    known = tc.Recording(jnp.ones(30), matrix(30), noise_variance=1.0)
    psfs = tc.Recording(seen, tc.Psfs(jnp.ones((2, 4, 5))))
    for recording in (known, psfs):
        message = "a synthesis needs Cameras; leave it out with"
        rig.refused(message, lambda r=recording: r.problem(synthesis=np.eye(1)))


HOLED = np.where(np.arange(42) == 9, np.nan, 1.0).reshape(1, 6, 7)
ENDLESS = np.where(np.arange(42) == 9, np.inf, 1.0).reshape(1, 6, 7)


@pytest.mark.parametrize(
    ("captures", "psfs", "more", "error", "message"),
    [
        (np.ones((1, 6, 7), complex), np.ones((1, 3, 3)), {}, TypeError, "complex128 .* real"),
        (np.ones((1, 6, 7, 3)), np.ones((1, 3, 3)), {}, ValueError, "the colours last.*moveaxis"),
        (np.ones((1, 6, 7)), np.ones((1, 6, 7, 3)), {}, ValueError, "psfs .* the colours last"),
        (np.ones((1, 6, 7)), np.zeros((1, 3, 3)), {}, ValueError, "zero everywhere"),
        (np.ones((1, 6, 7)), np.ones((1, 3, 3)), {"valid": False}, ValueError, "valid is False"),
        (
            ENDLESS,
            np.ones((1, 3, 3)),
            {},
            ValueError,
            r"captures\[0\] holds NaN .* valid=numpy.isf",
        ),
        (np.ones((1, 6, 7)), HOLED, {}, ValueError, "the PSFs hold NaN or infinity"),
        (np.ones((1, 6, 7)), -np.ones((1, 3, 3)), {}, ValueError, "a PSF sums to -9, which is neg"),
    ],
)
def test_captures_that_cannot_be_meant(captures, psfs, more, error, message):
    with pytest.raises(error, match=message):
        tc.Recording(captures, tc.Psfs(psfs), **more)


def test_a_field_that_does_not_fit_is_refused_before_any_work():
    imaging_model = tc.Psfs(np.ones((1, 3, 3)), field_shape=(200_000, 200_000))
    recording = tc.Recording(np.ones((1, 6, 7)), imaging_model)
    with pytest.raises(MemoryError, match="a field of 200000×199999 pixels needs about .* smaller"):
        tc.reconstruct(recording, tc.Ridge())


def test_captures_that_are_known_inside_jit_are_checked_there():
    capture = jnp.asarray(RNG.uniform(1, 2, (6, 7)))

    @jax.jit
    def residual(psf):
        known = {"noise_variance": 1.0, "background": 0.0}
        problem = tc.Recording([capture], tc.Psfs(psf[None]), **known).problem()
        return total_misfit(jnp.zeros(problem.image_shape), problem)

    psf = jnp.ones((3, 3))
    np.testing.assert_allclose(residual(psf), 0.5 * np.sum(np.square(capture)), rtol=1e-6)
    holed = jnp.asarray(ENDLESS[0])
    with pytest.raises(ValueError, match=r"captures\[0\] holds NaN"):
        jax.jit(lambda psf: tc.Recording([holed], tc.Psfs(psf[None])).problem())(psf)


def test_captures_without_noise_scale_too():
    """A shadow on a dark ground has none: a thousandth of its root mean square is assumed."""
    seen = np.zeros((1, 20, 23))
    seen[0, 8:12, 9:14] = 3.0
    one, other = (psf_problem(f * seen, np.ones((1, 3, 3))) for f in (1.0, 1e-6))
    np.testing.assert_allclose(1 / one.weights[0], 1e-6 * np.mean(seen**2), rtol=1e-9)
    np.testing.assert_allclose(other.absolute_tau, 1e6 * one.absolute_tau, rtol=1e-9)
    given = psf_problem(seen, np.ones((1, 3, 3)), noise_variance=0.0)
    np.testing.assert_allclose(given.weights[0], one.weights[0])
    dark = psf_problem(np.zeros((1, 20, 23)), np.ones((1, 3, 3)))
    np.testing.assert_array_equal(dark.weights[0], 1.0)


def test_iterative_solvers_say_what_works_under_jit():
    recording = tc.Recording(np.ones((1, 6, 7)), tc.Psfs(np.ones((1, 3, 3))))
    solve = jax.jit(lambda r: tc.reconstruct(r, tc.AdmmTV()).image)
    with pytest.raises(TypeError, match=r"AdmmTV .* jit.*tc\.reconstruction\.solve_fixed_point"):
        solve(recording)
