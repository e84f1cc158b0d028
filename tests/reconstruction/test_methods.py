"""`reconstruct`: recordings go to their solver, and which one is picked where none is given."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig

import thincam_jax as tc
from thincam_jax.imaging.operators import Matrix
from thincam_jax.reconstruction import (
    SOLVERS,
    Reconstruction,
    WienerSynthesis,
    phase_pairs,
    separate,
)

RNG = np.random.default_rng(1)
PAIR = np.array([[1.0, -1.0]])


def test_it_is_the_wiener_synthesis():
    """With the same settings; by default each capture by itself."""
    cameras = rig.seen_by(rig.pair())
    captures = rig.captures(rig.pair(), rig.picture())
    recording = tc.Recording(list(captures), cameras, noise_variance=1e-7)
    value = tc.reconstruct(recording, tc.Wiener(prior="flat"))
    direct = WienerSynthesis(cameras, synthesis=separate(2), prior="flat")
    np.testing.assert_array_equal(value.image, direct(captures, 1e-7).image)
    again = tc.Wiener(prior="flat").prepare(cameras)(captures, 1e-7)
    np.testing.assert_array_equal(value.image, again.image)
    assert value.status == "ok" and float(value.pitch) == pytest.approx(rig.OBJECT_PITCH)
    assert value.method == "wiener" and value.reason == "" and value.tau is None


def test_raw_counts_are_taken_as_they_are():
    """Whole numbers from a camera's file, in which a variance below one would be lost."""
    captures = rig.captures(rig.pair(), rig.picture())
    counts = jnp.round(captures / captures.max() * 4000)
    cameras, solver = rig.seen_by(rig.pair()), tc.Wiener(synthesis=phase_pairs(1))
    expected = tc.reconstruct(tc.Recording(counts, cameras, noise_variance=0.3), solver)
    raw = np.asarray(counts).astype(np.uint16)
    value = tc.reconstruct(tc.Recording(raw, cameras, noise_variance=0.3), solver)
    np.testing.assert_array_equal(value.image, expected.image)
    assert rig.correlation(value.image, rig.picture()) > 0.9


def test_the_filter_estimates_the_noise_it_is_not_told():
    sigma = 1e-3
    captures = rig.captures(rig.pair(), rig.picture())
    noisy = captures + sigma * jnp.asarray(RNG.normal(size=captures.shape))
    cameras, solver = rig.seen_by(rig.pair()), tc.Wiener(synthesis=PAIR)
    images = [
        tc.reconstruct(tc.Recording(noisy, cameras, noise_variance=v), solver).image
        for v in (None, sigma**2, 10 * sigma**2)
    ]
    near, far = (float(jnp.linalg.norm(images[0] - other)) for other in images[1:])
    assert near < 0.1 * far


def test_status_tells_of_nan():
    assert Reconstruction(jnp.ones((2, 3)), jnp.asarray(0.1)).status == "ok"
    captures = rig.captures(rig.pair(), rig.picture())
    recording = tc.Recording(captures, rig.seen_by(rig.pair()), noise_variance=1e-7)
    # Given so, it is refused; what is traced cannot be looked at.
    recording = eqx.tree_at(lambda r: r.captures[0], recording, captures[0].at[3, 5].set(jnp.nan))
    assert tc.reconstruct(recording, tc.Wiener()).status == "non_finite"


def test_every_solver_has_a_word():
    assert list(SOLVERS) == ["wiener", "fringe_scanning", "admm_tv", "fista", "ridge", "poisson"]
    for name, solver in SOLVERS.items():
        assert solver.name == name and solver().name == name  # each has defaults for all it takes


def test_what_is_refused():
    captures = jnp.ones((2, *rig.SENSOR.shape))
    recording = tc.Recording(captures, rig.seen_by(rig.pair()))
    rig.refused("prior = 'x' is unknown; choose one of 'inverse_sq", lambda: tc.Wiener(prior="x"))
    for value in (captures, rig.pair()):
        message = r"recording is a \w+; give tc.Recording\(captures, tc.Cameras"
        rig.refused(message, lambda v=value: tc.reconstruct(v), TypeError)
    for value in ("wiener", tc.AdmmTV):
        message = r"solver is .*; give a solver, such as tc.AdmmTV\(tau=2.0\)"
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
    masked = tc.Recording(seen, rig.seen_by(rig.phases()), valid=jnp.ones(seen.shape, bool))
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
            bare = tc.Recording(seen, rig.seen_by(rig.phases(), **{missing: None}))
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
    recording = tc.Recording(seen, rig.seen_by(cameras), noise_variance=variance, **known)
    solver, reason = tc.choose_solver(recording, synthesis)
    np.testing.assert_array_equal(solver.synthesis, synthesis)
    return solver.name, reason


def test_measured_psfs_and_operators_need_the_crop():
    for seen_by, message in (
        (tc.Psfs(jnp.ones((2, 5, 6))), "PSFs were measured"),
        ([Matrix(jnp.ones((6, 20)), (4, 5), (2, 3))] * 2, "operators were given"),
    ):
        solver, reason = tc.choose_solver(tc.Recording(jnp.ones((2, 2, 3)), seen_by))
        assert solver.name == "admm_tv" and message in reason


def test_what_a_filter_cannot_leave_out_or_tell_apart():
    seen = captures(0.001)
    method, reason = choice(seen, rig.pair(), PAIR, valid=jnp.ones(seen.shape, bool))
    assert method == "admm_tv" and "not to be trusted" in reason
    planes = rig.seen_by(rig.pair(), object_distance=[80.0, 100.0])
    solver, reason = tc.choose_solver(tc.Recording(seen, planes), PAIR)
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


def test_colours_and_darkness():
    """A batch is judged as one; nothing at all is no reason for a filter."""
    colour = jnp.stack([captures(0.02)] * 3, axis=1)
    assert choice(colour, rig.pair(), PAIR)[0] == "wiener"
    assert choice(0 * colour, rig.pair(), PAIR)[0] == "admm_tv"
    # clean captures, of which most of the pixels are dark
    clean = jnp.zeros((2, 96, 85)).at[0, 30:40, 20:30].set(1.0)
    assert choice(clean, rig.pair(), PAIR)[0] == "wiener"


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
    cameras = rig.seen_by(rig.pair())
    recording = tc.Recording(clean + 1e-5 * errors, cameras)
    solver, reason = tc.choose_solver(recording, PAIR)
    clear = tc.reconstruct(recording, solver)
    assert clear.method == "wiener" and "contrast" in reason and clear.status == "ok"
    assert rig.correlation(clear.image, rig.picture()) > 0.95
    solver, reason = tc.choose_solver(tc.Recording(clean + 0.02 * errors, cameras), PAIR)
    assert isinstance(solver, tc.AdmmTV) and "total variation" in reason
    solver, reason = tc.choose_solver(recording)
    assert isinstance(solver, tc.AdmmTV) and "background" in reason
