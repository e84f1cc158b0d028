"""`reconstruct`: the settings go to the right method, bad ones are refused with a list."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig

import thincam_jax as tc
from helpers import shared_data
from thincam_jax.reconstruction import METHODS, Reconstruction, phase_pairs, psf_problem, separate
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.regularised import middle

SETTINGS = {
    "object_distance": rig.OBJECT_DISTANCE,
    "wavelength": rig.WAVELENGTH,
    "noise_variance": 1e-7,
    "field_shape": rig.FIELD,
    "model": "geometric",
    "pixel_integration": False,
}


def test_it_is_the_wiener_synthesis():
    """With the same settings; by default each capture by itself."""
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture())
    fixed = {k: v for k, v in SETTINGS.items() if k != "noise_variance"}
    value = tc.reconstruct(list(captures), cameras, prior="flat", **SETTINGS)
    direct = tc.WienerSynthesis(cameras, synthesis=separate(2), prior="flat", **fixed)
    np.testing.assert_array_equal(value.image, direct(captures, 1e-7).image)
    assert value.status == "ok" and float(value.pitch) == pytest.approx(rig.OBJECT_PITCH)


def test_raw_counts_are_taken_as_they_are():
    """Whole numbers from a camera's file, in which a variance below one would be lost."""
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture())
    counts = jnp.round(captures / captures.max() * 4000)
    settings = SETTINGS | {"synthesis": phase_pairs(1), "noise_variance": 0.3}
    expected = tc.reconstruct(counts, cameras, **settings)
    with rig.unchecked():
        value = tc.reconstruct(np.asarray(counts).astype(np.uint16), cameras, **settings)
    np.testing.assert_array_equal(value.image, expected.image)
    assert rig.correlation(value.image, rig.picture()) > 0.9


def test_status_tells_of_what_is_not_a_number():
    assert Reconstruction(jnp.ones((2, 3)), jnp.asarray(0.1)).status == "ok"
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture()).at[0, 3, 5].set(jnp.nan)
    assert tc.reconstruct(captures, cameras, **SETTINGS).status == "non_finite"


def test_what_is_refused():
    cameras = rig.pair()
    captures = jnp.ones((2, *rig.SENSOR.shape))
    assert METHODS[:4] == ("auto", "wiener", "fringe_scanning", "admm_tv")
    with rig.unchecked():
        for name, message in (
            ("method", "method = 'x' is unknown; choose one of 'auto', 'wiener'"),
            ("prior", "prior = 'x' is unknown; choose one of 'inverse_square', 'flat'"),
            ("model", "model = 'x' is unknown; choose one of 'geometric', 'paraxial'"),
        ):
            with pytest.raises(ValueError, match=message):
                tc.reconstruct(captures, cameras, **(SETTINGS | {name: "x"}))
    with pytest.raises(ValueError, match=r"captures have shape \(2, 96, 85\) for 1 cameras"):
        tc.reconstruct(captures, cameras[:1], **SETTINGS)
    message = r"shape \(96, 85\) for 2 cameras; give \(2, …, y, x\)"
    with rig.unchecked(), pytest.raises(ValueError, match=message):
        tc.reconstruct(list(captures[0]), cameras, **SETTINGS)
    for missing in ("wavelength", "noise_variance", "object_distance"):
        with pytest.raises(ValueError, match=f"method 'wiener' needs {missing}"):
            tc.reconstruct(captures, cameras, **(SETTINGS | {missing: None}))


def variation(captures, cameras, **settings):
    """Total variation by ADMM; of cameras if they are such, else of measured PSFs."""
    fixed = {k: v for k, v in SETTINGS.items() if k not in ("noise_variance", "field_shape")}
    if not isinstance(cameras, list):
        fixed = {}
    return tc.reconstruct(captures, cameras, **({"method": "admm_tv"} | fixed | settings))


def noisy(count=2, noise=0.005):
    """A pair's captures with noise of half a per cent of the brightest."""
    captures = rig.captures(rig.pair(), rig.picture())[:count]
    errors = np.random.default_rng(6).normal(size=captures.shape)
    return captures + noise * captures.max() * jnp.asarray(errors)


def test_total_variation_is_upright_and_nearer_than_the_filter():
    """Two noisy captures with their bright backgrounds, which the sensor crops."""
    seen, picture = noisy(), rig.picture()
    history = []
    result = variation(seen, rig.pair(), field_shape=rig.FIELD, callback=history.append)
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
    filtered = tc.reconstruct(
        seen, rig.pair(), **(SETTINGS | {"noise_variance": (0.005 * 0.19) ** 2})
    )
    assert error < float(jnp.linalg.norm(filtered.image - picture))


def test_a_warm_start_is_given_upright_and_converges_sooner():
    """For cameras and for PSFs; what is given is the image that was returned."""
    cases = (
        (noisy(), rig.pair(), rig.FIELD),
        (noisy(1)[:, :40, :41], jnp.asarray(rig.picture((9, 10)))[None], (31, 32)),
    )
    for seen, cameras, field in cases:
        settings = {"field_shape": field, "tolerance": 3e-3, "iterations": 300}
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
    """Stopped by a callback, interrupted, not a number: the best image until then."""
    seen = noisy(1)[:, :40, :41]
    psf = jnp.asarray(rig.picture((9, 10)))[None]
    stopped = variation(seen, psf, callback=lambda p: p.iteration >= 20)
    assert (stopped.status, stopped.iterations) == ("stopped", 20)

    def interrupt(progress):
        if progress.iteration == 20:
            raise KeyboardInterrupt

    interrupted = variation(seen, psf, callback=interrupt)
    assert (interrupted.status, interrupted.iterations) == ("interrupted", 20)
    np.testing.assert_array_equal(interrupted.image, stopped.image)
    broken = variation(seen.at[0, 3, 4].set(jnp.nan), psf)
    assert broken.status == "non_finite"
    once = variation(seen, psf, iterations=7)
    assert (once.status, once.iterations) == ("iterations_exhausted", 7)


@pytest.mark.parametrize("kernel", [(9, 10), (60, 51)])
def test_extremes_are_finite(kernel):
    """No light, saturated, no trusted pixel, one bright pixel, no variation, nothing but that."""
    shape = (30, 23)
    psf = jnp.asarray(rig.picture(kernel))[None]
    ones, zeros = jnp.ones((1, *shape)), jnp.zeros((1, *shape))
    ordinary = jnp.asarray(np.random.default_rng(0).uniform(size=(1, *shape)))
    for captures, settings in (
        (zeros, {}),
        (4095.0 * ones, {}),
        (4095.0 * ones, {"valid": jnp.zeros(ones.shape, bool)}),
        (zeros.at[0, 7, 20].set(1.0), {}),
        (ordinary, {"tau": 0.0}),
        (ordinary, {"tau": 1e6}),
        (ordinary, {"noise_variance": 0.0}),
    ):
        result = variation(captures, psf, iterations=20, **settings)
        assert result.image.shape == shape and bool(jnp.isfinite(result.image).all())
        assert result.status in ("converged", "iterations_exhausted")
        assert float(result.image.min()) >= 0
        if captures is zeros or "valid" in settings:
            assert result.status == "converged"
            np.testing.assert_array_equal(result.image, 0)


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_the_image_scales_with_the_captures(factor):
    """In single precision, with noise that is estimated; colours keep their axis."""
    seen = jnp.asarray(noisy(1)[:, None, :40, :41], jnp.float32) * jnp.ones((3, 1, 1), jnp.float32)
    psf = jnp.asarray(rig.picture((9, 10)), jnp.float32)[None]
    one, other = (variation(jnp.float32(f) * seen, psf, iterations=20) for f in (1.0, factor))
    assert other.image.shape == (3, 40, 41) and other.image.dtype == jnp.float32
    error = jnp.linalg.norm(other.image / jnp.float32(factor) - one.image)
    assert 0 < float(jnp.linalg.norm(one.image)) and float(error) < 1e-3 * float(
        jnp.linalg.norm(one.image)
    )


def test_planes_get_an_axis():
    result = variation(
        noisy(), rig.pair(), field_shape=rig.FIELD, object_distance=[80.0, 100.0], iterations=5
    )
    assert result.image.shape == (2, *rig.FIELD)
    np.testing.assert_allclose(result.pitch, [0.8 * rig.OBJECT_PITCH, rig.OBJECT_PITCH])


def test_auto_gives_a_method_and_a_reason():
    """The filter estimates the noise if it is not told."""
    difference = np.array([[1.0, -1.0]])
    settings = SETTINGS | {"method": "auto", "noise_variance": None, "iterations": 5}
    clear = tc.reconstruct(noisy(noise=1e-5), rig.pair(), synthesis=difference, **settings)
    assert clear.method == "wiener" and "contrast" in clear.reason and clear.status == "ok"
    assert rig.correlation(clear.image, rig.picture()) > 0.95
    grainy = tc.reconstruct(noisy(noise=0.02), rig.pair(), synthesis=difference, **settings)
    assert grainy.method == "admm_tv" and "total variation" in grainy.reason
    biased = tc.reconstruct(noisy(), rig.pair(), **settings)
    assert biased.method == "admm_tv" and "background" in biased.reason
    measured = tc.reconstruct(noisy(1), jnp.ones((1, 5, 6)), method="auto", iterations=1)
    assert measured.method == "admm_tv" and "measured" in measured.reason


def test_what_total_variation_refuses():
    seen, psf = jnp.ones((1, 20, 21)), jnp.ones((1, 5, 6))
    for settings, message in (
        ({"relaxation": 2.5}, "relaxation = 2.5 is out of range; give 0 < α < 2"),
        ({"relaxation": 0.0}, "relaxation = 0 is out of range"),
        ({"iterations": 0}, "iterations = 0; give a whole number of at least 1"),
        ({"tolerance": -1.0}, "tolerance = -1.0 .* is negative"),
        ({"tau": -1.0}, "tau = -1.0 .* is negative"),
        ({"start": jnp.ones((3, 20, 21))}, r"start has shape \(3, 20, 21\); give an image"),
        ({"start": jnp.ones((40, 41))}, "start has 40×41 pixels, more than the field's"),
        ({"method": "wiener"}, "method 'wiener' needs cameras; with measured PSFs use 'admm_tv'"),
    ):
        with rig.unchecked(), pytest.raises(ValueError, match=message) as refused:
            variation(seen, psf, **settings)
        assert "\n" not in str(refused.value)
    captures = jnp.ones((2, *rig.SENSOR.shape))
    for missing in ("object_distance", "wavelength"):
        with pytest.raises(ValueError, match=f"method 'admm_tv' needs {missing}"):
            variation(captures, rig.pair(), **{missing: None})
    with (
        rig.unchecked(),
        pytest.raises(ValueError, match=r"captures have shape \(1, 20, 21\) for 2 cameras"),
    ):
        variation(seen, rig.pair())


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


def test_a_real_capture():
    """DiffuserCam's hand: like the published reconstruction; by the data only with its own PSF."""
    raw, psf, expected = hand()
    raw, psf = jnp.asarray(raw)[None], jnp.asarray(psf)[None]
    field = psf_problem(raw, psf).field_shape
    residual = []
    for kernel in (psf, psf[..., ::-1, ::-1]):
        result = tc.reconstruct(raw, kernel, method="admm_tv", iterations=100, field_shape=field)
        assert result.status in ("converged", "iterations_exhausted")
        gap = residuals(psf_problem(raw, kernel), result.image[None, None])[0]
        residual.append(float(jnp.linalg.norm(gap) / jnp.linalg.norm(raw)))
        if kernel is psf:
            seen = middle(result.image, raw.shape[-2:])
    image = jax.image.resize(seen, expected.shape, "linear")
    either = (image, image[::-1], image[:, ::-1], image[::-1, ::-1])  # the page may be turned
    assert max(rig.correlation(x, expected) for x in either) > 0.97
    assert residual[0] < 0.025 and residual[1] > 2 * residual[0]
