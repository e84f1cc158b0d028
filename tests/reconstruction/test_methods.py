"""`reconstruct`, the choice of a solver, and the regularised solvers of a recording."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, rig

import thincam_jax as tc
from thincam_jax.imaging.operators import Matrix
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.reconstruction import TotalVariation
from thincam_jax.reconstruction.regularisers import Sparsity, Wavelet
from thincam_jax.reconstruction.synthesis import separate
from thincam_jax.reconstruction.wiener import WienerSynthesis

RNG = np.random.default_rng(1)
PAIR = np.array([[1.0, -1.0]])


def test_it_is_the_wiener_synthesis():
    """With the same settings; by default each capture by itself."""
    cameras = rig.imaging_model(rig.pair())
    captures = rig.captures(rig.pair(), rig.picture())
    recording = tc.Recording(list(captures), cameras, noise_variance=1e-7)
    value = tc.reconstruct(recording, tc.Wiener(prior="flat", synthesis=separate(2)))
    direct = WienerSynthesis(cameras, synthesis=separate(2), prior="flat")
    np.testing.assert_array_equal(value.image, direct(captures, 1e-7).image)
    again = tc.Wiener(prior="flat", synthesis=separate(2)).prepare(cameras)(captures, 1e-7)
    np.testing.assert_array_equal(value.image, again.image)
    assert value.status == "ok" and float(value.pitch) == pytest.approx(rig.OBJECT_PITCH)
    assert value.method == "wiener" and value.reason == "" and value.tau is None


def test_the_filter_estimates_the_noise_it_is_not_told():
    sigma = 1e-3
    captures = rig.captures(rig.pair(), rig.picture())
    noisy = captures + sigma * jnp.asarray(RNG.normal(size=captures.shape))
    cameras, solver = rig.imaging_model(rig.pair()), tc.Wiener(synthesis=PAIR)
    images = [
        tc.reconstruct(tc.Recording(noisy, cameras, noise_variance=v), solver).image
        for v in (None, sigma**2, 10 * sigma**2)
    ]
    near, far = (float(jnp.linalg.norm(images[0] - other)) for other in images[1:])
    assert near < 0.1 * far


def test_what_is_refused():
    captures = jnp.ones((2, *rig.SENSOR.shape))
    recording = tc.Recording(captures, rig.imaging_model(rig.pair()))
    rig.refused("prior = 'x' is unknown; choose one of 'inverse_sq", lambda: tc.Wiener(prior="x"))
    for value in (captures, rig.pair()):
        message = r"recording is .*; give Recording\(captures, imaging_model, …\)"
        rig.refused(message, lambda v=value: tc.reconstruct(v), TypeError)
    for value in (7, tc.AdmmTV):
        message = r"solver is .*; give an AbstractSolver, such as \w+"
        rig.refused(message, lambda v=value: tc.reconstruct(recording, v), TypeError)
    for solver in (tc.Wiener(), tc.FringeScanning(), tc.Ridge()):
        for given in ({"start": jnp.ones(rig.FIELD)}, {"callback": print}):
            message = f"{type(solver).__name__} runs in one piece; leave out start and callback"
            rig.refused(message, lambda s=solver, g=given: tc.reconstruct(recording, s, **g))


def test_filters_need_cameras_whose_pixels_are_all_valid():
    psfs = tc.Recording(jnp.ones((1, 20, 21)), tc.Psfs(jnp.ones((1, 5, 6))))
    operator = Matrix(jnp.ones((6, 20)), (4, 5), (6,))
    others = "AdmmTV, Fista, Ridge or PoissonTV"
    seen = jnp.ones((4, *rig.SENSOR.shape))
    masked = tc.Recording(seen, rig.imaging_model(rig.phases()), valid=jnp.ones(seen.shape, bool))
    for solver in (tc.Wiener(), tc.FringeScanning()):
        needs = (
            f"method '{solver.name}' needs cameras; with measured PSFs or operators use {others}"
        )
        rig.refused(needs, lambda s=solver: tc.reconstruct(psfs, s))
        vectors = tc.Recording(jnp.ones(6), operator, noise_variance=1.0)
        rig.refused(needs, lambda s=solver, v=vectors: tc.reconstruct(v, s))
        message = f"method '{solver.name}' cannot leave out pixels that are not valid; use {others}"
        rig.refused(message, lambda s=solver: tc.reconstruct(masked, s))
        for missing in ("wavelength", "object_distance"):
            bare = tc.Recording(seen, rig.imaging_model(rig.phases(), **{missing: None}))
            if missing == "object_distance" or solver.name == "wiener":
                message = f"the Cameras have no {missing}; give it in mm"
                rig.refused(message, lambda s=solver, b=bare: tc.reconstruct(b, s))


def captures(noise):
    """A bright ground of 10, a pattern of ±1 of opposite sign in the two captures, white noise."""
    pattern = np.sign(np.sin(np.arange(96)[:, None] / 5) * np.sin(np.arange(85) / 7 + 0.1))
    clean = 10 + np.stack([pattern, -pattern])
    return jnp.asarray(clean + noise * RNG.normal(size=clean.shape))


def choice(seen, cameras, synthesis, variance=None, **known):
    """The word of the solver that is picked, and its reason; it takes the same sums."""
    recording = tc.Recording(seen, rig.imaging_model(cameras), noise_variance=variance, **known)
    solver, reason = tc.choose_solver(recording, synthesis=synthesis)
    np.testing.assert_array_equal(solver.synthesis, synthesis)
    return solver.name, reason


def test_measured_psfs_and_operators_need_the_crop():
    for imaging_model, message in (
        (tc.Psfs(jnp.ones((2, 5, 6))), "PSFs were measured"),
        ([Matrix(jnp.ones((6, 20)), (4, 5), (2, 3))] * 2, "operators were given"),
    ):
        solver, reason = tc.choose_solver(tc.Recording(jnp.ones((2, 2, 3)), imaging_model))
        assert solver.name == "admm_tv" and message in reason and "PlugAndPlay" in reason


@pytest.fixture(scope="module")
def low_rank_recording():
    rng = np.random.default_rng(3)
    psfs = rng.uniform(size=(3, 3, 5, 5)) ** 4
    operator = low_rank_psf(psfs, 1.0, (16, 19), (16, 19), tolerance=1e-3).operator
    image = np.zeros((16, 19))
    image[4:9, 5:12] = 1.0
    seen = operator(jnp.asarray(image)) + 0.05 * rng.normal(size=image.shape)
    return tc.Recording(seen, operator, noise_variance=0.05**2)


def test_low_rank_operators_take_proximal_gradients(low_rank_recording):
    """One application an iteration in place of a linear system."""
    solver, reason = tc.choose_solver(low_rank_recording)
    assert solver.name == "fista" and "sum of many convolutions" in reason


def test_what_a_filter_cannot_leave_out_or_tell_apart():
    seen = captures(0.001)
    method, reason = choice(seen, rig.pair(), PAIR, valid=jnp.ones(seen.shape, bool))
    assert method == "admm_tv" and "not to be trusted" in reason
    planes = rig.imaging_model(rig.pair(), object_distance=[80.0, 100.0])
    solver, reason = tc.choose_solver(tc.Recording(seen, planes), synthesis=PAIR)
    assert solver.name == "admm_tv" and "several planes" in reason


@pytest.mark.parametrize(
    ("synthesis", "count"), [(None, "2 of 2"), (np.array([[1.0, 1.0], [1.0, -1.0]]), "1 of 2")]
)
def test_a_background_that_is_kept_needs_the_crop(synthesis, count):
    method, reason = choice(captures(0.001), rig.pair(), synthesis)
    assert method == "admm_tv" and reason.startswith(f"{count} channels keep the bright background")


def test_backgrounds_of_unlike_apertures_do_not_cancel():
    cameras = [rig.camera(0.0), rig.camera(0.0, width=1.4)]
    method, reason = choice(captures(0.001), cameras, PAIR)
    assert method == "admm_tv" and reason.startswith("1 of 1 channels keep the bright background")


@pytest.mark.parametrize(
    ("synthesis", "variance", "message"),
    [
        (np.ones((1, 3)), None, r"synthesis has shape \(1, 3\); give \(channels, 2\)"),
        (PAIR, jnp.ones(3), r"noise_variance has shape \(3,\); give one number or one for each"),
    ],
)
def test_what_does_not_fit_is_told_before_the_choice(synthesis, variance, message):
    rig.refused(message, lambda: choice(captures(0.001), rig.pair(), synthesis, variance))


@pytest.mark.parametrize("known", [True, False])
def test_contrast_over_noise_decides_else(known):
    """The difference has a contrast of 2 over a noise of √2 σ: √2/σ, whether σ is told or not."""
    for noise, expected in ((0.2, "admm_tv"), (0.056, "admm_tv"), (0.039, "wiener")):
        variance = noise**2 if known else None
        method, reason = choice(captures(noise), rig.pair(), PAIR, variance)
        assert method == expected
        told = float(reason.split("contrast is ")[1].split()[0])
        assert told == pytest.approx(2**0.5 / noise, rel=0.06)
    each = choice(captures(0.1), rig.pair(), PAIR, jnp.asarray([0.01, 0.03]))
    told = float(each[1].split("contrast is ")[1].split()[0])
    assert told == pytest.approx(2 / 0.04**0.5, rel=0.05)


def test_a_choice_is_made_where_no_solver_is_given():
    """The result says by what it was made, and why."""
    seen = jnp.ones((1, 20, 21)).at[0, 7, 8].set(5.0)
    measured = tc.reconstruct(tc.Recording(seen, tc.Psfs(jnp.ones((1, 5, 6)))))
    assert measured.method == "admm_tv" and "PSFs were measured" in measured.reason
    assert measured.tau == 2.0 and measured.iterations > 0


def test_the_chosen_solver_makes_the_image():
    """The filter estimates the noise if it is not told; biased captures go to total variation."""
    clean = rig.captures(rig.pair(), rig.picture())
    errors = clean.max() * jnp.asarray(np.random.default_rng(6).normal(size=clean.shape))
    cameras = rig.imaging_model(rig.pair())
    recording = tc.Recording(clean + 1e-5 * errors, cameras)
    solver, reason = tc.choose_solver(recording, synthesis=PAIR)
    clear = tc.reconstruct(recording, solver)
    assert clear.method == "wiener" and "contrast" in reason and clear.status == "ok"
    assert rig.correlation(clear.image, rig.picture()) > 0.95
    solver, reason = tc.choose_solver(tc.Recording(clean + 0.02 * errors, cameras), synthesis=PAIR)
    assert isinstance(solver, tc.AdmmTV) and "total variation" in reason
    solver, reason = tc.choose_solver(recording)
    assert isinstance(solver, tc.AdmmTV) and "background" in reason


def variation(captures, imaging_model, start=None, callback=None, known=None, **settings):
    """Total variation by ADMM; of a recording about which `known` is known."""
    recording = tc.Recording(captures, imaging_model, **(known or {}))
    return tc.reconstruct(recording, tc.AdmmTV(**settings), start=start, callback=callback)


def noisy(count=2, noise=0.005):
    """A pair's captures with noise of half a per cent of the brightest."""
    captures = rig.captures(rig.pair(), rig.picture())[:count]
    errors = np.random.default_rng(6).normal(size=captures.shape)
    return captures + noise * captures.max() * jnp.asarray(errors)


@pytest.mark.thorough
def test_a_warm_start_is_given_upright_and_converges_sooner():
    """For cameras and for PSFs; what is given is the image that was returned."""
    psfs = tc.Psfs(jnp.asarray(rig.picture((9, 10)))[None], field_shape=(31, 32))
    cases = ((noisy(), rig.imaging_model(rig.pair())), (noisy(1)[:, :40, :41], psfs))
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


@pytest.mark.parametrize("kind", [tc.AdmmTV, tc.Fista])
def test_what_is_out_of_range_is_refused(kind):
    for tau, message in ((-1.0, "tau = -1.0 is negative"), ("best", "choose one of 'disc")):
        rig.refused(message, lambda t=tau: kind(t))
    psf = tc.Recording(jnp.ones((1, 20, 21)), tc.Psfs(jnp.ones((1, 5, 6))))
    for start, message in (
        (jnp.ones((3, 20, 21)), r"start has shape \(3, 20, 21\); give an image"),
        (jnp.ones((40, 41)), "start has 40×41 pixels, more than the field's"),
        (jnp.ones(7), r"start has shape \(7,\)"),
        (0, r"start has shape \(\); give an image"),
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
    message = "tau = 'sure' is for total variation only; give a number, about 1 to 3"
    rig.refused(message, lambda: tc.Fista("sure", regulariser=Sparsity()))
    assert tc.Fista("sure", regulariser=TotalVariation()).tau == "sure"


@pytest.mark.thorough
def test_recordings_at_the_extremes():
    extremes.check_recordings(tc.AdmmTV(iterations=30))
