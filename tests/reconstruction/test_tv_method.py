"""ADMM-TV under `drive`: it reaches the minimum, tells how near it is, balances its penalties."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig, scenes
from reconstruction.test_admm import case, energy, reference

from helpers import relative_l2
from thincam_jax.reconstruction import tv_method
from thincam_jax.reconstruction.admm import Penalties, image_of
from thincam_jax.reconstruction.drive import drive
from thincam_jax.reconstruction.tv_method import AdmmTotalVariation


def solve(problem, *, iterations=1500, tolerance=1e-9, image=None, **settings):
    method = AdmmTotalVariation(problem, relaxation=settings.pop("relaxation", 1.7))
    image = jnp.zeros(problem.image_shape, problem.tau.dtype) if image is None else image
    settings = {"adapt_until": iterations // 2} | settings
    return drive(method, image, iterations=iterations, tolerance=tolerance, **settings)


@pytest.mark.parametrize("name", ["colour_anisotropic", "planes"])
def test_it_converges_to_the_minimum_of_another_method(name):
    """With its own penalties, which start 10 times too large for these problems and adapt."""
    given = case(name)
    outcome = solve(given.problem, iterations=4000)
    expected = reference(given)
    assert outcome.status == "converged"
    assert relative_l2(np.asarray(outcome.image).reshape(expected.shape), expected) < 1e-6
    assert energy(given, outcome.image) == pytest.approx(energy(given, expected), rel=1e-9)
    # the history is that of the objective, and ends at the lowest
    last, values = outcome.history[-1], [p.objective for p in outcome.history]
    assert values[-1] == pytest.approx(energy(given, expected), rel=1e-9)
    assert min(values) >= energy(given, expected) * (1 - 1e-9)
    assert max(last.primal, last.dual) < 1e-9


def test_the_best_image_is_that_of_the_lowest_objective():
    problem, _ = scenes.problem()
    outcome = solve(problem, iterations=40, tolerance=0.0)
    assert outcome.status == "iterations_exhausted"
    method = AdmmTotalVariation(problem)
    best = min(p.objective for p in outcome.history)
    assert float(method.objective(outcome.image)) == pytest.approx(best, rel=1e-12)


def test_residuals_are_what_their_names_say():
    """Primal: Kf − z against the larger of the two; dual: how far z moved, against the forces."""
    problem, _ = scenes.problem()
    method = AdmmTotalVariation(problem, relaxation=1.3)
    state = method.advance(method.start(jnp.full(problem.image_shape, 0.3)), 7)
    before = jax.tree.map(jnp.copy, state)
    after, found = method.look(state)
    parts = (method.splitting, method.penalties)
    old, new = (tv_method._consensus(*parts, s) for s in (before, after))
    image = jax.tree.map(lambda z, a, b: z + (a - b) / 1.3, old, after, before)

    def size(tree):
        """Lengths in the metric of the penalties."""
        total = 0.0
        for name, leaf in (("data", "data"), ("slopes", "variation"), ("image", "image")):
            weight = float(getattr(method.penalties, leaf))
            for part in jax.tree.leaves(getattr(tree, name)):
                total += weight * float((np.asarray(part) ** 2).sum())
        return total**0.5

    gap = jax.tree.map(jnp.subtract, image, old)
    forces = jax.tree.map(jnp.subtract, after, new)
    assert found.dual == pytest.approx(
        size(jax.tree.map(jnp.subtract, new, old)) / size(forces), rel=1e-10
    )
    # each split takes the larger of Kf and z
    assert found.primal <= size(gap) / max(size(image), size(old)) * (1 + 1e-10)
    assert found.primal >= size(gap) / (size(image) ** 2 + size(old) ** 2) ** 0.5
    assert len(found.parts) == 3 and all(p > 0 and d > 0 for p, d in found.parts)


def test_balance_moves_penalties_the_right_way():
    """From penalties far too large or too small, ten times nearer to the minimum with balance."""
    given = case("colour")
    lowest = energy(given, reference(given))
    for factor in (300.0, 1 / 300.0):
        method = AdmmTotalVariation(given.problem, relaxation=1.5)
        bad = jax.tree.map(lambda p, f=factor: p * f, method.penalties)
        method = eqx.tree_at(lambda m: m.penalties, method, bad)
        first = jnp.zeros(given.problem.image_shape)
        errors = []
        for until in (0, 150):
            run = drive(method, first, iterations=300, tolerance=0.0, adapt_until=until)
            errors.append(energy(given, run.image) / lowest - 1)
        assert errors[1] < 0.1 * errors[0]


def test_balanced_penalties_keep_the_image():
    problem, _ = scenes.problem()
    method = AdmmTotalVariation(problem)
    state, residuals = method.look(method.start(jnp.full(problem.image_shape, 0.3)))
    uneven = residuals._replace(parts=((4.0, 1.0), (1.0, 100.0), (1.0, 1.0)))
    before = method.image(state)
    other, changed = method.adapt(state, uneven)
    assert isinstance(other, AdmmTotalVariation)
    np.testing.assert_allclose(other.image(changed), before, atol=1e-12)
    expected = Penalties(*(jnp.asarray(f) for f in (2.0, 1 / 3, 1.0)))
    for old, new, factor in zip(
        *(jax.tree.leaves(p) for p in (method.penalties, other.penalties, expected)), strict=True
    ):
        assert float(new / old) == pytest.approx(float(factor), rel=1e-12)
    # nothing is rebuilt for a balance that is good enough
    even = residuals._replace(parts=((1.1, 1.0), (1.0, 1.1), (0.0, 1.0)))
    assert method.adapt(state, even)[0] is method


def test_no_light_converges_at_once():
    problem, _ = scenes.problem()
    dark = eqx.tree_at(
        lambda p: p.captures, problem, tuple(jnp.zeros_like(c) for c in problem.captures)
    )
    outcome = solve(dark, iterations=50)
    assert (outcome.status, outcome.iterations) == ("converged", 10)
    np.testing.assert_array_equal(outcome.image, 0)


def test_single_precision_and_no_new_compilation():
    """New captures, τ, relaxation and penalties of old shapes; all residuals are finite."""
    problem, _ = scenes.problem()
    expected = solve(problem, iterations=30, tolerance=0.0)
    value = solve(scenes.single(problem), iterations=30, tolerance=0.0)
    assert value.image.dtype == jnp.float32
    assert relative_l2(value.image, expected.image) < 1e-4
    assert all(np.isfinite(p[1:]).all() for p in value.history[1:])
    sizes = tv_method._advance._cache_size(), tv_method.step_and_residuals._cache_size()
    solve(scenes.rescaled(problem, 3.0), iterations=30, tolerance=0.0, relaxation=1.1)
    assert sizes == (tv_method._advance._cache_size(), tv_method.step_and_residuals._cache_size())
    assert rig.correlation(expected.image, value.image) > 0.999


def test_a_warm_start_goes_on_where_the_image_was():
    """From a minimiser the image stays one: the first look is at its objective."""
    given = case("two")
    done = solve(given.problem)
    lowest = energy(given, done.image)
    again = solve(given.problem, image=done.image, iterations=10, tolerance=0.0)
    assert again.history[0].objective == pytest.approx(lowest, rel=1e-12)
    assert energy(given, again.image) <= lowest * (1 + 1e-12)
    state = AdmmTotalVariation(given.problem).start(done.image)
    back = image_of(AdmmTotalVariation(given.problem).splitting, state)
    np.testing.assert_allclose(back, done.image, atol=1e-12)
