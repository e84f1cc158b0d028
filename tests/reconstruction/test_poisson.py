"""Poisson likelihood: its pieces against scipy, its gradient, and that it beats least squares."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from reconstruction import extremes, scenes

from helpers import finite_difference, relative_l2
from thincam_jax.reconstruction.poisson import (
    LINKS,
    Counts,
    half_deviance,
    poisson_loss,
    poisson_objective,
    positive,
    smooth_variation,
    solve_poisson,
    unlinked,
)
from thincam_jax.reconstruction.poisson_newton import (
    Weighed,
    anscombe,
    deviance_residual,
    newton_objective,
    photon_residuals,
    solve_poisson_newton,
)
from thincam_jax.reconstruction.proximal import solve_proximal
from thincam_jax.reconstruction.total_variation import TotalVariation


def photons(mean=3.0, background=0.1, seed=0, **settings):
    """Counts of a dark scene with a few bright blocks, and the scene."""
    problem, truth = scenes.problem(noise=0.0, tau=0.0, kernel=scenes.spots, captures=1, **settings)
    truth = truth - 0.1
    light = problem.operators[0](truth)
    gain = mean / float(jnp.mean(light))
    seen = np.random.default_rng(seed).poisson(np.maximum(light * gain, 0) + background)
    captures = (jnp.asarray(seen.astype(float)),)
    return eqx.tree_at(lambda p: p.captures, problem, captures), truth * gain


def weighing(problem, tau):
    return eqx.tree_at(lambda p: p.tau, problem, jnp.asarray(tau))


@pytest.mark.parametrize("count", [0, 1, 7, 200])
def test_the_deviance_is_that_of_the_distribution(count):
    means = np.array([0.01, 0.5, 7.0, 230.0])
    best = scipy.stats.poisson.logpmf(count, max(count, 1e-300))
    wanted = best - scipy.stats.poisson.logpmf(count, means)
    found = half_deviance(jnp.full(4, float(count)), jnp.asarray(means))
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
    residual = deviance_residual(jnp.full(4, float(count)), jnp.asarray(means))
    np.testing.assert_allclose(residual**2 / 2, wanted, rtol=1e-7, atol=1e-9)
    assert np.all(np.sign(residual) == np.sign(means - count))


def test_residuals_are_smooth_where_count_and_mean_agree():
    for of in (deviance_residual, anscombe):
        slope = jax.vmap(jax.grad(lambda m, of=of: of(jnp.asarray(50.0), m)))
        near = slope(50 * (1 + jnp.array([-1e-2 - 1e-7, -1e-2 + 1e-7, 0.0, 1e-9])))
        np.testing.assert_allclose(near[0], near[1], rtol=1e-6)
        np.testing.assert_allclose(near[2:], 1 / np.sqrt(50), rtol=5e-3)


def test_anscombe_residuals_have_unit_variance():
    counts = np.random.default_rng(2).poisson(9.0, 200_000).astype(float)
    residuals = anscombe(jnp.asarray(counts), jnp.asarray(9.0))
    assert abs(float(jnp.var(residuals)) - 1) < 0.02


def test_the_smooth_variation_is_between_tv_and_tv_less_half_the_smoothing():
    image = jnp.asarray(np.random.default_rng(1).normal(size=(2, 3, 1, 9, 7)))
    for variation in (TotalVariation(), TotalVariation(coupling="joint")):
        whole, smooth = variation(image), smooth_variation(variation, image, 0.01)
        assert np.all(smooth < whole)
        assert np.all(whole - 0.005 * 3 * 63 < smooth)
    tiny = 1e-4 * image
    slopes = sum(jnp.sum(jnp.diff(tiny, axis=a) ** 2, axis=(1, 2, 3, 4)) for a in (-1, -2))
    np.testing.assert_allclose(
        smooth_variation(TotalVariation(), tiny, 0.01), slopes / 0.02, rtol=1e-9
    )


@pytest.mark.parametrize("link", LINKS)
def test_gradient_by_differences_and_links_that_come_back(link):
    problem, _ = photons(sensor=(9, 11), field=(7, 6))
    counts = Counts(weighing(problem, 0.2), background=[0.1], link=link)
    rng = np.random.default_rng(6)
    theta = jnp.asarray(rng.uniform(0.5, 1.5, problem.image_shape))
    direction = jnp.asarray(rng.normal(size=theta.shape))
    wanted = finite_difference(lambda t: poisson_loss(t, counts), theta, direction, 1e-4)
    slope = jnp.vdot(jax.grad(poisson_loss)(theta, counts), direction)
    np.testing.assert_allclose(slope, wanted, rtol=1e-7)
    values = jnp.array([1e-3, 0.3, 1.0, 40.0])
    np.testing.assert_allclose(positive(link, unlinked(link, values)), values, rtol=1e-10)


@pytest.mark.parametrize("seed", [0, 1])
def test_it_beats_least_squares_at_three_counts_a_pixel(seed):
    """Both with TV, f ≥ 0 and the background, each with the τ that suits it best."""
    background = 0.1
    problem, truth = photons(background=background, seed=seed)
    level = float(truth.mean())
    likely = [
        solve_poisson(weighing(problem, t / level), background=[background], link="square")
        for t in (0.1, 0.2, 0.3, 0.5)
    ]
    clear = eqx.tree_at(lambda p: p.captures, problem, (problem.captures[0] - background,))
    squares = [
        solve_proximal(weighing(clear, 3 * t / level), iterations=150, tolerance=1e-4)
        for t in (0.5, 0.7, 1.0, 1.4, 2.0)
    ]
    likely, squares = ([relative_l2(o.image, truth) for o in found] for found in (likely, squares))
    # The best is not at an end of what was tried.
    assert np.argmin(squares) not in (0, 4)
    assert min(likely) < 0.92 * min(squares)


@pytest.mark.thorough
def test_links_and_methods_agree_on_the_minimum():
    problem, _ = photons(mean=30.0, sensor=(13, 12), field=(9, 10))
    tau = weighing(problem, 0.02)
    values = [
        solve_poisson(tau, background=[0.1], link=link, iterations=800, tolerance=1e-6)
        for link in LINKS
    ]
    lowest = min(v.history[-1].objective for v in values)
    for v in values:
        assert v.history[-1].objective < lowest * (1 + 2e-3)
        assert float(v.image.min()) >= 0


@pytest.mark.parametrize("residual", ["anscombe", "deviance"])
def test_newton_ends_where_no_image_beside_is_better(residual):
    problem, truth = photons(mean=20.0, sensor=(13, 12), field=(9, 10))
    found = solve_poisson_newton(
        problem, smoothness=3.0, background=[0.1], residual=residual, iterations=100
    )
    assert found.status == "converged"
    counts = Counts(problem, background=[0.1], link="square")
    weighed = Weighed(counts, jnp.asarray(3.0), residual)
    lowest = newton_objective(weighed, found.image)
    rng = np.random.default_rng(3)
    for size in (0.01, 0.1):
        for _ in range(10):
            other = found.image * jnp.exp(size * jnp.asarray(rng.normal(size=truth.shape)))
            assert newton_objective(weighed, other) > lowest
    # Its data part, with deviance residuals, is the likelihood itself.
    data, _ = photon_residuals(weighed, found.image)
    if residual == "deviance":
        plain = Counts(weighing(problem, 0.0), background=[0.1], link="square")
        likelihood = poisson_objective(plain, found.image)
        np.testing.assert_allclose(jnp.sum(data[0] ** 2) / 2, likelihood, rtol=1e-9)


@pytest.mark.parametrize(
    "solve",
    [
        functools.partial(solve_poisson, iterations=20),
        functools.partial(solve_poisson_newton, smoothness=0.1, iterations=5),
    ],
    ids=["l-bfgs", "newton"],
)
@pytest.mark.thorough
def test_it_stands_extremes(solve):
    extremes.check_shapes(solve, noise=0.0)
    # Without a count the image is of at most what would have given about one.
    problem, _ = photons()
    dark = eqx.tree_at(lambda p: p.captures, problem, (jnp.zeros_like(problem.captures[0]),))
    outcome = solve(dark)
    assert bool(jnp.isfinite(outcome.image).all())
    assert float(jnp.sum(problem.operators[0](outcome.image))) < 1.0
    single = solve(scenes.single(problem))
    assert single.image.dtype == jnp.float32 and bool(jnp.isfinite(single.image).all())


def test_what_are_no_counts_is_refused():
    problem, _ = scenes.problem()
    negative = eqx.tree_at(lambda p: p.captures, problem, tuple(c - 100 for c in problem.captures))
    with pytest.raises(ValueError, match="negative counts"):
        solve_poisson(negative)
    with pytest.raises(ValueError, match="1 backgrounds for 2 captures"):
        solve_poisson(problem, background=[0.1])
