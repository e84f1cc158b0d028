"""`AdmmTV` and `Fista`: the image that was seen, upright; how a run begins and ends; extremes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import rig

import thincam_jax as tc
from helpers import relative_l2, shared_data
from thincam_jax.reconstruction import Cosines, Sparsity, Wavelet
from thincam_jax.reconstruction.fista import solve_fista
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.recording import middle


def variation(captures, seen_by, start=None, callback=None, known=None, **settings):
    """Total variation by ADMM; of a recording about which `known` is known."""
    recording = tc.Recording(captures, seen_by, **(known or {}))
    return tc.reconstruct(recording, tc.AdmmTV(**settings), start=start, callback=callback)


def noisy(count=2, noise=0.005):
    """A pair's captures with noise of half a per cent of the brightest."""
    captures = rig.captures(rig.pair(), rig.picture())[:count]
    errors = np.random.default_rng(6).normal(size=captures.shape)
    return captures + noise * captures.max() * jnp.asarray(errors)


@pytest.mark.thorough
def test_total_variation_is_upright_and_nearer_than_the_filter():
    """Two noisy captures with their bright backgrounds, which the sensor crops."""
    seen, picture = noisy(), rig.picture()
    history = []
    cameras = rig.seen_by(rig.pair())
    result = variation(seen, cameras, callback=history.append)
    assert result.method == "admm_tv" and result.reason == ""
    assert result.status in ("converged", "iterations_exhausted")
    assert result.image.shape == rig.FIELD and float(result.image.min()) >= 0
    assert rig.correlation(result.image, picture) > 0.99
    assert rig.correlation(result.image[::-1, ::-1], picture) < 0.5
    scale = np.vdot(result.image, picture) / np.vdot(picture, picture)
    assert scale == pytest.approx(1.0, abs=0.05)
    assert float(result.pitch) == pytest.approx(rig.OBJECT_PITCH)
    assert tuple(history) == result.history[1:] and result.iterations == history[-1].iteration
    error = float(jnp.linalg.norm(result.image - picture))
    recording = tc.Recording(seen, cameras, noise_variance=(0.005 * 0.19) ** 2)
    filtered = tc.reconstruct(recording, tc.Wiener())
    assert error < float(jnp.linalg.norm(filtered.image - picture))


@pytest.mark.thorough
def test_a_warm_start_is_given_upright_and_converges_sooner():
    """For cameras and for PSFs; what is given is the image that was returned."""
    psfs = tc.Psfs(jnp.asarray(rig.picture((9, 10)))[None], field_shape=(31, 32))
    cases = ((noisy(), rig.seen_by(rig.pair())), (noisy(1)[:, :40, :41], psfs))
    for seen, cameras in cases:
        settings = {"tolerance": 3e-3, "iterations": 300}
        cold = variation(seen, cameras, **settings)
        warm = variation(seen, cameras, start=cold.image, **settings)
        assert cold.status == warm.status == "converged"
        assert warm.iterations <= cold.iterations
        lowest = min(p.objective for p in cold.history)
        assert warm.history[0].objective == pytest.approx(lowest, rel=1e-9)
        upside_down = settings | {"iterations": 1, "start": cold.image[::-1, ::-1]}
        turned = variation(seen, cameras, **upside_down)
        assert turned.history[0].objective > 1.05 * lowest


def test_endings():
    """Stopped by a callback, interrupted, NaN: the best image until then."""
    seen = noisy(1)[:, :40, :41]
    psf = tc.Psfs(jnp.asarray(rig.picture((9, 10)))[None])
    stopped = variation(seen, psf, callback=lambda p: p.iteration >= 20)
    assert (stopped.status, stopped.iterations) == ("stopped", 20)

    def interrupt(progress):
        if progress.iteration == 20:
            raise KeyboardInterrupt

    interrupted = variation(seen, psf, callback=interrupt)
    assert (interrupted.status, interrupted.iterations) == ("interrupted", 20)
    np.testing.assert_array_equal(interrupted.image, stopped.image)
    once = variation(seen, psf, iterations=7)
    assert (once.status, once.iterations) == ("iterations_exhausted", 7)


@pytest.mark.thorough
@pytest.mark.parametrize("kernel", [(9, 10), pytest.param((60, 51), marks=pytest.mark.thorough)])
def test_extremes_are_finite(kernel):
    """No light, saturated, one bright pixel, no variation, nothing but that."""
    shape = (30, 23)
    psf = tc.Psfs(jnp.asarray(rig.picture(kernel))[None])
    ones, zeros = jnp.ones((1, *shape)), jnp.zeros((1, *shape))
    ordinary = jnp.asarray(np.random.default_rng(0).uniform(size=(1, *shape)))
    for captures, settings in (
        (zeros, {}),
        (4095.0 * ones, {}),
        (zeros.at[0, 7, 20].set(1.0), {}),
        (ordinary, {"tau": 0.0}),
        (ordinary, {"tau": 1e6}),
        (ordinary, {"known": {"noise_variance": 0.0}}),
    ):
        result = variation(captures, psf, iterations=20, **settings)
        assert result.image.shape == shape and bool(jnp.isfinite(result.image).all())
        assert result.status in ("converged", "iterations_exhausted")
        assert float(result.image.min()) >= 0
        if captures is zeros:
            assert result.status == "converged"
            np.testing.assert_array_equal(result.image, 0)


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_the_image_scales_with_the_captures(factor):
    """In single precision, with noise that is estimated; colours keep their axis."""
    seen = jnp.asarray(noisy(1)[:, None, :40, :41], jnp.float32) * jnp.ones((3, 1, 1), jnp.float32)
    psf = tc.Psfs(jnp.asarray(rig.picture((9, 10)), jnp.float32)[None])
    one, other = (variation(jnp.float32(f) * seen, psf, iterations=20) for f in (1.0, factor))
    assert other.image.shape == (3, 40, 41) and other.image.dtype == jnp.float32
    error = jnp.linalg.norm(other.image / jnp.float32(factor) - one.image)
    assert 0 < float(jnp.linalg.norm(one.image)) and float(error) < 1e-3 * float(
        jnp.linalg.norm(one.image)
    )


@pytest.mark.thorough
def test_planes_get_an_axis():
    planes = rig.seen_by(rig.pair(), object_distance=[80.0, 100.0])
    result = variation(noisy(), planes, iterations=5)
    assert result.image.shape == (2, *rig.FIELD)
    np.testing.assert_allclose(result.pitch, [0.8 * rig.OBJECT_PITCH, rig.OBJECT_PITCH])


@pytest.mark.parametrize("kind", [tc.AdmmTV, tc.Fista, tc.Ridge, tc.PoissonTV])
def test_when_to_end_is_checked_at_once(kind):
    """Of every solver that has iterations."""
    for settings, message in (
        ({"iterations": 0}, "iterations = 0; give a whole number of at least 1"),
        ({"iterations": True}, "iterations = True; give a whole number of at least 1"),
        ({"iterations": 3.0}, "iterations = 3.0; give a whole number of at least 1"),
        ({"tolerance": -1.0}, "tolerance = -1.0 is negative"),
    ):
        rig.refused(message, lambda s=settings: kind(**s))


@pytest.mark.parametrize("kind", [tc.AdmmTV, tc.Fista])
def test_what_is_out_of_range_is_refused(kind):
    for tau, message in ((-1.0, "tau = -1.0 is negative"), ("best", "choose one of 'disc")):
        rig.refused(message, lambda t=tau: kind(t))
    psf = tc.Recording(jnp.ones((1, 20, 21)), tc.Psfs(jnp.ones((1, 5, 6))))
    for start, message in (
        (jnp.ones((3, 20, 21)), r"start has shape \(3, 20, 21\); give an image"),
        (jnp.ones((40, 41)), "start has 40×41 pixels, more than the field's"),
        (jnp.ones(7), r"start has shape \(7,\)"),
    ):
        rig.refused(message, lambda s=start: tc.reconstruct(psf, kind(), start=s))


def test_regularisers_that_a_solver_cannot_take_are_refused():
    """Fista takes total variation as well as any other."""
    rig.refused(
        "variation is a Sparsity; give a TotalVariation", lambda: tc.AdmmTV(variation=Sparsity())
    )
    rig.refused(
        "regulariser is a Wavelet; give a Regulariser", lambda: tc.Fista(regulariser=Wavelet())
    )
    message = "tau = 'sure' is found for total variation only; give a number, about 1 to 3"
    rig.refused(message, lambda: tc.Fista("sure", regulariser=Sparsity()))
    assert tc.Fista("sure", regulariser=tc.TotalVariation()).tau == "sure"


SHAPE = (40, 41)


def cosines(noise=0.02):
    """A recording of three cosines through a blur, and the scene."""
    kernel = rig.picture((9, 10)) - 0.25
    kernel /= kernel.sum()
    shape = (SHAPE[0] + 8, SHAPE[1] + 9)
    details = np.zeros(shape)
    details[0, 0], details[2, 3], details[5, 1], details[0, 7] = 60.0, 8.0, -6.0, 5.0
    truth = np.asarray(Cosines().synthesise(jnp.asarray(details)))
    seen = scipy.signal.convolve2d(truth, kernel, mode="valid")
    seen += noise * np.random.default_rng(2).normal(size=seen.shape)
    psfs = tc.Psfs(jnp.asarray(kernel)[None], field_shape=shape)
    return tc.Recording(jnp.asarray(seen)[None], psfs, noise_variance=noise**2), truth


@pytest.mark.thorough
def test_a_regulariser_takes_the_place_of_total_variation():
    """Few cosines are found better as such than as an image of few edges, with the same τ."""
    recording, truth = cosines()
    sparse = tc.reconstruct(recording, tc.Fista(regulariser=Sparsity(Cosines())))
    edges = tc.reconstruct(recording, tc.AdmmTV())
    assert sparse.tau == edges.tau == 2.0
    assert relative_l2(sparse.image, truth) < 0.6 * relative_l2(edges.image, truth)


@pytest.mark.thorough
def test_it_is_that_of_the_solver():
    """From a black image, for measured PSFs; the problem is that of the recording."""
    recording, _ = cosines()
    basis = Sparsity(Wavelet("haar", levels=2))
    how = {"iterations": 20, "tolerance": 0.0}
    found = tc.reconstruct(recording, tc.Fista(1.0, regulariser=basis, **how))
    problem = recording.problem(tau=1.0, regulariser=basis)
    direct = solve_fista(problem, image=jnp.zeros(problem.image_shape), **how)
    np.testing.assert_allclose(found.image, direct.image[0, 0], rtol=1e-12)
    assert found.history[-1].objective == pytest.approx(direct.history[-1].objective)
    assert found.method == "fista" and found.tau == 1.0


def hand():
    """The hand of DiffuserCam by blocks of 4×4 pixels, its PSF, and the published image of it."""
    image_files = pytest.importorskip("PIL.Image")
    folder = shared_data("diffusercam-hand")

    def load(name):
        counts = np.asarray(image_files.open(folder / name), dtype=np.float32)
        return counts

    psf, raw = load("psf_sample.tif"), load("rawdata_hand_sample.tif")
    background = psf[5:15, 5:15].mean()
    psf, raw = (
        np.maximum(x - background, 0).reshape(x.shape[0] // 4, 4, x.shape[1] // 4, 4).mean((1, 3))
        for x in (psf, raw)
    )
    page = image_files.open(folder / "reference_admm5_notebook_output.png").convert("L")
    return raw, psf / psf.sum(), np.asarray(page, dtype=float)[23:239, 34:323]


@pytest.mark.thorough
def test_a_real_capture():
    """DiffuserCam's hand: like the published reconstruction; by the data only with its own PSF."""
    raw, psf, expected = hand()
    raw, psf = jnp.asarray(raw)[None], jnp.asarray(psf)[None]
    field = tc.Recording(raw, tc.Psfs(psf)).problem().field_shape
    residual = []
    for kernel, iterations in ((psf, 60), (psf[..., ::-1, ::-1], 30)):
        recording = tc.Recording(raw, tc.Psfs(kernel, field_shape=field))
        result = tc.reconstruct(recording, tc.AdmmTV(iterations=iterations))
        assert result.status in ("converged", "iterations_exhausted")
        gap = residuals(recording.problem(), result.image[None, None])[0]
        residual.append(float(jnp.linalg.norm(gap) / jnp.linalg.norm(raw)))
        if kernel is psf:
            seen = middle(result.image, raw.shape[-2:])
    image = jax.image.resize(seen, expected.shape, "linear")
    either = (image, image[::-1], image[:, ::-1], image[::-1, ::-1])  # the page may be turned
    assert max(rig.correlation(x, expected) for x in either) > 0.97
    assert residual[0] < 0.025 and residual[1] > 2 * residual[0]
