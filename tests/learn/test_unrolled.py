"""Unrolled ADMM: untrained it is ADMM, trained it is better on scenes it has not seen."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, scenes

from helpers import finite_difference
from thincam_jax.learn.unrolled import Adam, UnrolledAdmm, train, training_loss
from thincam_jax.reconstruction.admm import admm_map
from thincam_jax.reconstruction.iterate import Outcome
from thincam_jax.reconstruction.problem import uniform_image
from thincam_jax.reconstruction.splittings import splitting_of


def pairs(count, seed):
    """Scenes and their captures with 1 % of noise."""
    problem, _ = scenes.problem((17, 19), (13, 14), captures=1, batch=(count,))
    images = np.stack([scenes.blocks((13, 14), seed=seed + n) for n in range(count)])
    images = jnp.asarray(images[:, None, None])
    seen = problem.operators[0](images)
    noise = jnp.asarray(np.random.default_rng(seed).normal(size=seen.shape))
    seen = seen + 0.01 * float(seen.max()) * noise
    return eqx.tree_at(lambda p: p.captures, problem, (seen,)), images


@pytest.mark.thorough
def test_untrained_it_is_admm():
    problem, _ = scenes.problem((17, 19), (13, 14), planes=2)
    splitting = splitting_of(problem)
    state = splitting.start(uniform_image(problem))
    advance = jax.jit(admm_map)
    for _ in range(4):
        state = advance(state, splitting)
    found = UnrolledAdmm(problem, 4)(problem)
    np.testing.assert_allclose(found, splitting.image(state), atol=1e-10)


@pytest.mark.thorough
def test_trained_it_beats_as_many_untrained_iterations_on_scenes_it_has_not_seen():
    seen, images = pairs(10, 100)
    unseen, others = pairs(8, 900)
    model = UnrolledAdmm(seen, 5)
    before = training_loss(model, unseen, others)
    training = train(model, seen, images, key=jax.random.key(1), descent=Adam(steps=60))
    assert training.status == "iterations_exhausted" and len(training.losses) == 60
    after = training_loss(training.model, unseen, others)
    assert after < 0.75 * before
    # Its five iterations are worth more than eight of those.
    assert after < training_loss(UnrolledAdmm(seen, 8), unseen, others)
    for positive in training.model.parameters():
        assert float(positive.min()) > 0
    # Training again with the same key gives the same.
    again = train(model, seen, images, key=jax.random.key(1), descent=Adam(steps=3))
    assert again.losses == training.losses[:3]


@pytest.mark.thorough
def test_the_gradient_is_that_of_differences():
    problem, images = pairs(2, 40)
    model = UnrolledAdmm(problem, 3)
    rng = np.random.default_rng(2)
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), model)
    loss = functools.partial(training_loss, problem=problem, images=images)
    wanted = finite_difference(loss, model, direction, 1e-5)
    slope = jax.jit(jax.grad(training_loss))(model, problem, images)
    found = sum(
        jnp.vdot(a, b)
        for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(direction), strict=True)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-3)


@pytest.mark.thorough
def test_it_stands_extremes():
    def solve(problem, model=None):
        image = (model or UnrolledAdmm(problem, 3))(problem)
        return Outcome(image, "iterations_exhausted", (), 3, 0.0)

    extremes.check_shapes(solve)
    extremes.check_darkness(solve)
    model = UnrolledAdmm(scenes.single(scenes.problem()[0]), 3)
    extremes.check_scale(functools.partial(solve, model=model))


def test_pairs_that_do_not_fit_are_refused():
    problem, images = pairs(3, 7)
    model = UnrolledAdmm(problem, 2)
    with pytest.raises(ValueError, match="give captures"):
        train(model, problem, images[:2], key=jax.random.key(0))
    with pytest.raises(ValueError, match="batch = 4 of 3 pairs"):
        train(model, problem, images, key=jax.random.key(0))
    with pytest.raises(ValueError, match="at least 1"):
        UnrolledAdmm(problem, 0)
