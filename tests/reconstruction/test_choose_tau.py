"""τ found from the captures: against a scan of the true error, of the true risk, of the misfit."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.reconstruction import InverseProblem
from thincam_jax.reconstruction.choose_tau import discrepancy_tau, sure_tau
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.problem import misfit, with_tau
from thincam_jax.reconstruction.splittings import admm_method

SENSOR, SIGMA = (30, 37), 0.02


def mean_squared_error(image, truth):
    return jnp.mean((image - truth) ** 2)


def scene(seed=0):
    """Even patches on a dark ground, as large as the whole field, (1, 1, y, x)."""
    random, image = np.random.default_rng(seed), np.zeros((1, 1, 38, 45))
    for _ in range(5):
        top, left = random.integers(4, 24), random.integers(4, 30)
        image[..., top : top + 9, left : left + 11] += random.uniform(0.3, 1)
    return jnp.asarray(image)


def _psf(seed=0):
    psf = np.random.default_rng(20 + seed).random((9, 9)) ** 4
    return psf / psf.sum()


def recording(capture, seed=0, **settings):
    return tc.Recording(
        capture, tc.Psfs(jnp.asarray(_psf(seed))[None], **settings), noise_variance=SIGMA**2
    )


def posed(seed=0, tau=2.0):
    """A blurred, cropped capture with noise, and the truth."""
    random = np.random.default_rng(10 + seed)
    truth = scene(seed)
    empty = recording(jnp.zeros((1, *SENSOR)), seed).problem()
    assert empty.image_shape == truth.shape
    capture = empty.operators[0](truth) + SIGMA * random.normal(size=(1, *SENSOR))
    return recording(capture, seed).problem(tau=tau), truth


def solved(problem, iterations=200):
    method = admm_method(problem, relaxation=1.5)
    first = jnp.zeros(problem.image_shape)
    return iterate(method, first, Schedule(iterations, 1e-7)).image


@pytest.mark.thorough
def test_a_start_a_hundred_times_off_finds_the_same():
    problem, other = posed(tau=20.0)[0], posed(tau=0.5)[0]
    chosen, again = (
        discrepancy_tau(p, jnp.zeros(p.image_shape), iterations=100, solves=12)
        for p in (problem, other)
    )
    assert float(again.problem.tau) == pytest.approx(float(chosen.problem.tau), rel=0.05)


@pytest.mark.thorough
def test_discrepancy_makes_the_residual_of_the_valid_pixels_as_large_as_the_noise():
    problem, _ = posed()
    masked = jnp.ones((1, *SENSOR)).at[:, :15].set(0.0)
    weights = (masked / SIGMA**2,)
    half = InverseProblem(problem.operators, problem.captures, tau=problem.tau, weights=weights)
    chosen = discrepancy_tau(half, jnp.zeros(problem.image_shape), iterations=60, solves=10)
    assert 2 * float(misfit(chosen.problem, chosen.image).sum()) == pytest.approx(15 * 37, rel=0.03)


@pytest.mark.thorough
def test_the_risk_estimate_finds_the_least_true_risk_on_the_sensor(key):
    problem, truth = posed()
    clean = problem.operators[0](truth)

    def risk(tau):
        image = solved(with_tau(problem, tau))
        return float(jnp.sum((problem.operators[0](image) - clean) ** 2)) / SIGMA**2

    chosen = sure_tau(problem, jnp.zeros(problem.image_shape), key, iterations=100, solves=12)
    scan = [risk(float(problem.tau) * f) for f in np.geomspace(0.05, 20, 13)]
    assert risk(float(chosen.problem.tau)) < 1.15 * min(scan)
    # The estimate itself is the risk, to the accuracy of one probe.
    tau, estimate = chosen.tried[-1]
    assert estimate == pytest.approx(risk(tau), abs=0.15 * SENSOR[0] * SENSOR[1])


@pytest.mark.thorough
@pytest.mark.parametrize("rule", ["discrepancy", "sure"])
def test_the_entry_point_takes_a_rule(rule):
    """A τ a hundred times too small or found: the found one is nearer to the truth."""
    problem, truth = posed()
    seen = recording(problem.captures[0], field_shape=(38, 45))
    found, poor = (tc.reconstruct(seen, tc.AdmmTV(tau)) for tau in (rule, 0.02))
    errors = [float(mean_squared_error(r.image, truth[:, 0])) for r in (found, poor)]
    assert found.status in ("converged", "iterations_exhausted")
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.thorough
@pytest.mark.parametrize("rule", ["discrepancy", "sure"])
def test_a_wrong_psf_is_reported_and_does_not_lower_tau(rule):
    """No τ makes the residual as small as the noise: both fell to the border of 0.02."""
    problem, truth = posed()
    wrong = 0.6 * _psf(0) + 0.4 * _psf(1)
    psfs = tc.Psfs(jnp.asarray(wrong)[None], field_shape=(38, 45))
    seen = tc.Recording(problem.captures[0], psfs, noise_variance=SIGMA**2)
    found, default = (tc.reconstruct(seen, tc.AdmmTV(tau)) for tau in (rule, 2.0))
    assert "times the noise" in found.reason and "PSF is not quite right" in found.reason
    assert found.tau > 2.0
    errors = [float(mean_squared_error(r.image, truth[:, 0])) for r in (found, default)]
    assert errors[0] < errors[1]
    right = tc.reconstruct(recording(problem.captures[0], field_shape=(38, 45)), tc.AdmmTV(rule))
    assert not right.reason and right.tau < 8.1


def test_a_search_needs_a_positive_start():
    problem, _ = posed()
    with pytest.raises(ValueError, match="give tau > 0"):
        discrepancy_tau(with_tau(problem, 0.0), jnp.zeros(problem.image_shape))
