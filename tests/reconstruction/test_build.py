"""From captures to problems: registered, weighted, in units in which τ is about 1."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig
from scipy import signal

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution, kernel_shape
from thincam_jax.reconstruction.build import absolute_tau, camera_problem, object_pitch, psf_problem
from thincam_jax.reconstruction.problem import residuals

SENSOR, FIELD = tc.Sensor((52, 61), rig.SENSOR.pitch), (28, 33)
SETTINGS = {
    "object_distance": rig.OBJECT_DISTANCE,
    "wavelength": rig.WAVELENGTH,
    "field_shape": FIELD,
    "model": "geometric",
    "pixel_integration": False,
}
RNG = np.random.default_rng(8)


def cameras(count=2, **settings):
    return rig.phases(count, sensor=SENSOR, width=1.2, **settings)


def projected(image) -> jax.Array:
    """The scene turned over, as a field (channel, plane, y, x)."""
    return jnp.asarray(np.asarray(image)[None, None, ::-1, ::-1].copy())


def share(problem, image) -> list[float]:
    """‖√w (Hf − g)‖ / ‖√w g‖ of each capture."""
    gaps = residuals(problem, image)
    return [
        float(jnp.linalg.norm(jnp.sqrt(w) * r) / jnp.linalg.norm(jnp.sqrt(w) * g))
        for r, g, w in zip(gaps, problem.captures, problem.weights, strict=True)
    ]


def test_the_scene_explains_its_captures():
    """The image projected on the sensor through the operators is what `capture` says."""
    image = rig.picture(FIELD)
    seen = rig.captures(cameras(), image)
    problem = camera_problem(seen, cameras(), **SETTINGS)
    assert problem.field_shape == FIELD and len(problem.operators) == 2
    assert max(share(problem, projected(image))) < 1e-6
    assert min(share(problem, projected(image[::-1]))) > 0.02


def test_sums_of_captures_take_sums_of_kernels():
    """Differences of opposite phases: the residual of the scene vanishes, variances add."""
    image = rig.picture(FIELD)
    rigs = cameras(4)
    seen = rig.captures(rigs, image)
    rows = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 2.0, 0.0, -2.0]])
    problem = camera_problem(seen, rigs, synthesis=rows, noise_variance=[1.0, 2, 3, 4], **SETTINGS)
    assert max(share(problem, projected(image))) < 1e-6
    np.testing.assert_allclose(problem.captures[1][0], 2 * (seen[1] - seen[3]), rtol=1e-12)
    for weight, variance in zip(problem.weights, (1 + 3, 4 * (2 + 4)), strict=True):
        np.testing.assert_allclose(weight, 1 / variance, rtol=1e-12)


def test_two_distances_are_registered():
    """Method A: the nearer camera's capture enlarged; what lies beyond its rim is not used."""
    image = rig.picture(FIELD)
    rigs = cameras(1, distance=3.0) + cameras(1, distance=2.4)
    seen = rig.captures(rigs, image)
    problem = camera_problem(seen, rigs, **SETTINGS)
    assert problem.captures[1].shape[-2:] == (66, 77)  # 52·1.25 = 65, 61·1.25 = 76.25
    assert share(problem, projected(image))[0] < 1e-6
    assert share(problem, projected(image))[1] < 0.01
    trusted = np.asarray(problem.weights[1]) > 0
    assert trusted[2:-2, 2:-2].all() and bool((problem.weights[0] > 0).all())
    # beyond the rim the capture is dark, the model is not
    value = residuals(problem, projected(image))[1] + problem.captures[1]
    beyond = np.asarray(problem.captures[1][0])[~trusted]
    assert beyond.size > 60 and not beyond.any() and np.asarray(value[0])[~trusted].min() > 1e-3


def test_an_invalid_pixel_taints_what_is_interpolated_from_it():
    """What an invalid pixel changes by more than a hundredth of itself has no weight."""
    rigs = cameras(1, distance=3.0) + cameras(1, distance=2.4)
    seen = rig.captures(rigs, rig.picture(FIELD))
    valid = np.ones(seen.shape, bool)
    valid[1, 20, 30] = valid[0, 7, 9] = False
    bright = seen.at[1, 20, 30].add(1.0).at[0, 7, 9].add(1.0)
    clean, spoilt = (camera_problem(s, rigs, valid=valid, **SETTINGS) for s in (seen, bright))
    for k in (0, 1):
        change = np.abs(np.asarray(spoilt.captures[k] - clean.captures[k]))
        trusted = np.asarray(clean.weights[k])[None] > 0
        assert change.max() > 0.5 and change[trusted].max() < 0.011
    first = np.asarray(clean.weights[0])
    assert first[7, 9] == 0 and (first == 0).sum() == 1


def test_what_is_invalid_need_not_be_a_number():
    seen = rig.captures(cameras(), rig.picture(FIELD))
    noisy = seen + 1e-3 * jnp.asarray(RNG.normal(size=seen.shape))
    valid = np.ones(seen.shape, bool)
    valid[0, 3, 4] = valid[1, 20, 21] = False
    broken = noisy.at[0, 3, 4].set(jnp.nan).at[1, 20, 21].set(jnp.inf)
    for problem in (
        camera_problem(broken, cameras(), valid=valid, **SETTINGS),
        psf_problem(broken, broken[:, 30:39, 30:41], valid=valid),
    ):
        for leaf in jax.tree.leaves(problem):
            assert bool(jnp.isfinite(leaf).all())
        assert [int((w == 0).sum()) for w in problem.weights] == [1, 1]


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
    problem = camera_problem(seen, cameras(), **(SETTINGS | {"object_distance": distances}))
    assert problem.image_shape == (1, 2, *FIELD)
    both = jnp.concatenate([projected(front), projected(back)], axis=1)
    assert max(share(problem, both)) < 1e-6
    assert min(share(problem, both[:, ::-1])) > 1e-3
    np.testing.assert_allclose(
        object_pitch(cameras(), jnp.asarray(distances)), SENSOR.pitch * np.array(distances) / 3.0
    )


def test_the_field_takes_the_parity_of_the_sensor():
    seen = rig.captures(cameras(), rig.picture(FIELD))
    problem = camera_problem(seen, cameras(), **(SETTINGS | {"field_shape": (27, 33)}))
    assert problem.field_shape == (28, 33)
    whole = camera_problem(seen, cameras(), **(SETTINGS | {"field_shape": None}))
    assert whole.field_shape == SENSOR.shape


@pytest.mark.parametrize("sensor", [(12, 17), (13, 11)])
@pytest.mark.parametrize("kernel", [(5, 8), (7, 7), (12, 17), (13, 19), (29, 30), (40, 61)])
def test_measured_psfs_of_any_size(sensor, kernel):
    """Smaller, larger, odd, even, prime: by scipy's convolution of a field with the PSF.

    The field's middle falls on the sensor's; its samples that send light to the sensor are all in.
    """
    psf, capture = RNG.uniform(size=kernel), RNG.uniform(size=sensor)
    problem = psf_problem(jnp.asarray(capture)[None], jnp.asarray(psf)[None])
    assert problem.field_shape == tuple(s + k - 1 for s, k in zip(sensor, kernel, strict=True))
    image = RNG.normal(size=problem.field_shape)
    expected = signal.fftconvolve(image, psf, mode="full")
    corner = [k - 1 for k in kernel]
    expected = expected[corner[0] :, corner[1] :][: sensor[0], : sensor[1]]
    value = residuals(problem, jnp.asarray(image)[None, None])[0] + capture
    np.testing.assert_allclose(value[0], expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("field", [(9, 10), (10, 9)])
def test_a_field_that_is_given_is_smaller_by_one_at_most(field):
    """Its centre must lie on that of the samples; a point in its middle gives the PSF's middle."""
    psf = RNG.uniform(size=(5, 8))
    problem = psf_problem(jnp.ones((1, 12, 17)), jnp.asarray(psf)[None], field_shape=field)
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
    value = residuals(problem, jnp.asarray(image)[None, None])[0] + 1.0
    np.testing.assert_allclose(value[0], expected, atol=1e-10)


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_channels_and_planes_of_psfs(channels):
    """One PSF for all channels, one each, planes of each: every channel by its own convolution."""
    captures = jnp.asarray(RNG.uniform(size=(2, channels, 9, 8)))
    for shape in ((2, 4, 5), (2, 1, 4, 5), (2, channels, 4, 5), (2, channels, 3, 4, 5)):
        psfs = RNG.uniform(size=shape)
        problem = psf_problem(captures, jnp.asarray(psfs))
        planes = 3 if len(shape) == 5 else 1
        assert problem.image_shape == (channels, planes, 12, 12)
        image = RNG.normal(size=problem.image_shape)
        table = psfs.reshape(2, *shape[1:-2], *(1,) * (5 - len(shape)), *shape[-2:])
        for k, gap in enumerate(residuals(problem, jnp.asarray(image))):
            for c in range(channels):
                kernels = table[k, min(c, table.shape[1] - 1)]
                expected = sum(
                    signal.convolve(image[c, p], kernels[p], mode="valid") for p in range(planes)
                )
                np.testing.assert_allclose(gap[c] + captures[k, c], expected, atol=1e-12)


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
    value = absolute_tau(jnp.asarray(1.0), operators, [s**2 for s in sizes])
    assert float(value) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_problems_scale_with_their_captures(factor):
    """Noise estimated, single precision: weights fall and τ falls so that the image scales."""
    seen = RNG.uniform(size=(2, 20, 23)).astype(np.float32)
    psfs = jnp.asarray(RNG.uniform(size=(2, 7, 6)), jnp.float32)
    one = psf_problem(jnp.asarray(seen), psfs)
    other = psf_problem(jnp.asarray(seen) * jnp.float32(factor), psfs)
    np.testing.assert_allclose(other.tau, one.tau / factor, rtol=1e-5)
    for a, b in zip(one.weights, other.weights, strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a / factor**2, rtol=1e-5)


def test_captures_without_noise_scale_too():
    """A shadow on a dark ground has none: a thousandth of its root mean square is assumed."""
    seen = np.zeros((1, 20, 23))
    seen[0, 8:12, 9:14] = 3.0
    one, other = (psf_problem(jnp.asarray(f * seen), jnp.ones((1, 3, 3))) for f in (1.0, 1e-6))
    np.testing.assert_allclose(1 / one.weights[0], 1e-6 * np.mean(seen**2), rtol=1e-9)
    np.testing.assert_allclose(other.tau, 1e6 * one.tau, rtol=1e-9)
    given = psf_problem(jnp.asarray(seen), jnp.ones((1, 3, 3)), noise_variance=0.0)
    np.testing.assert_allclose(given.weights[0], one.weights[0])
    dark = psf_problem(jnp.zeros((1, 20, 23)), jnp.ones((1, 3, 3)))
    np.testing.assert_array_equal(dark.weights[0], 1.0)


def test_single_precision_captures_make_single_precision_problems():
    seen = rig.captures(cameras(), rig.picture(FIELD))
    double = camera_problem(seen, cameras(), noise_variance=1e-6, **SETTINGS)
    single = camera_problem(seen.astype(jnp.float32), cameras(), noise_variance=1e-6, **SETTINGS)
    assert single.tau.dtype == jnp.float32
    assert single.operators[0].spectrum.dtype == jnp.complex64
    value = np.asarray(single.operators[0].spectrum).astype(complex)
    assert relative_l2(value, double.operators[0].spectrum) < 1e-5


def test_what_is_refused():
    seen = jnp.ones((2, *SENSOR.shape))
    for captures, psfs, settings, message in (
        (seen, jnp.ones((3, 4, 5)), {}, r"PSFs have shape \(3, 4, 5\) for 2 captures; give"),
        (seen, jnp.ones((4, 5)), {}, r"PSFs have shape \(4, 5\) for 2 captures; give"),
        (seen, jnp.ones((2, 3, 4, 5)), {}, "1 channels and its PSF 3; give a PSF of 1 channel"),
        (seen, jnp.ones((2, 4, 5)), {"tau": -1.0}, "tau = -1.0 .* is negative"),
        (seen, jnp.ones((2, 4, 5)), {"field_shape": (0, 4)}, "field_shape = .* at least 1"),
        (seen, jnp.ones((2, 4, 5)), {"noise_variance": [1.0] * 3}, "noise_variance has shape"),
    ):
        with rig.unchecked(), pytest.raises(ValueError, match=message):
            psf_problem(captures, psfs, **settings)
    # a field of one sample whose centre cannot be that of the PSF's samples
    with pytest.raises(ValueError, match=r"kernel has shape \(5, 8\); its centre fits"):
        psf_problem(jnp.ones((1, 12, 17)), jnp.ones((1, 5, 8)), field_shape=(1, 1))
    with pytest.raises(ValueError, match=r"synthesis has shape \(1, 3\)"):
        camera_problem(seen, cameras(), synthesis=np.ones((1, 3)), **SETTINGS)


def test_kernels_reach_over_every_difference():
    """A PSF on `kernel_grid`: nothing of the field is left out, nothing wraps round."""
    problem = camera_problem(jnp.ones((2, *SENSOR.shape)), cameras(), **SETTINGS)
    rows, columns = kernel_shape(SENSOR.shape, FIELD)
    assert problem.window[0] >= rows and problem.window[1] >= columns
