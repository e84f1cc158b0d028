"""TwIST: its weights, that it never rises, its minimum, extremes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, scenes

from thincam_jax.reconstruction.proximal import solve_proximal
from thincam_jax.reconstruction.sparsity import Sparsity
from thincam_jax.reconstruction.two_step import TwoStep, solve_two_step, two_step, weights
from thincam_jax.reconstruction.wavelet import Wavelet

few = functools.partial(solve_two_step, iterations=10)


def test_the_weights_make_the_slowest_mode_of_a_linear_problem_fastest():
    """Modes of eigenvalue λ follow e₊ = (1−α)e₋ + (α−βλ)e: roots of at most ρ̂ for λ in [ξ, 1].

    With other weights some mode is slower.
    """

    def slowest(alpha, beta, smallest):
        roots = [
            np.abs(np.roots([1, -(alpha - beta * x), alpha - 1])).max()
            for x in np.linspace(smallest, 1, 200)
        ]
        return max(roots)

    smallest = 0.01
    alpha, beta = (float(x) for x in weights(jnp.asarray(smallest)))
    best = slowest(alpha, beta, smallest)
    np.testing.assert_allclose(best, (1 - 0.1) / (1 + 0.1), rtol=1e-6)
    for a, b in ((0.97, 1), (1.03, 1), (1, 0.97), (1, 1.03)):
        assert slowest(a * alpha, b * beta, smallest) > best + 1e-4


def test_the_objective_never_rises_and_two_steps_are_faster_than_one():
    problem, _ = scenes.problem(batch=(2,))
    method = TwoStep(problem)
    advance = eqx.filter_jit(lambda method, state: two_step(method, state)[0])
    state = method.start(jnp.zeros(problem.image_shape))
    values = [state.value]
    for _ in range(80):
        state = advance(method, state)
        values.append(state.value)
    assert np.all(np.diff(np.array(values), axis=0) <= 0)
    # With ξ = 1 the weights are those of one step, α = β = 1.
    single = TwoStep(problem, smallest_eigenvalue=1.0)
    state = single.start(jnp.zeros(problem.image_shape))
    for _ in range(80):
        state = advance(single, state)
    assert np.all(np.array(values[-1]) < 0.5 * np.array(state.value))


@pytest.mark.thorough
def test_it_finds_the_minimum_of_another_method():
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3)
    for regulariser in (None, Sparsity(Wavelet("haar", 2))):
        how = {"regulariser": regulariser, "tolerance": 1e-7}
        one = solve_two_step(problem, iterations=600, smallest_eigenvalue=1e-2, **how)
        other = solve_proximal(problem, iterations=400, **how)
        assert abs(one.history[-1].objective / other.history[-1].objective - 1) < 1e-4
        assert float(one.image.min()) >= 0


@pytest.mark.thorough
def test_it_stands_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)


@pytest.mark.thorough
def test_new_values_are_not_compiled_anew():
    from thincam_jax.reconstruction import two_step as module

    problem, _ = scenes.problem()
    few(problem)
    before = module._look._cache_size()
    few(scenes.rescaled(problem, 2.0), smallest_eigenvalue=0.3)
    assert module._look._cache_size() == before


@pytest.mark.parametrize("smallest", [0.0, 1.5])
def test_eigenvalues_beyond_the_largest_are_refused(smallest):
    with pytest.raises(ValueError, match="smallest_eigenvalue"):
        solve_two_step(scenes.problem()[0], smallest_eigenvalue=smallest)


def test_no_number_has_a_status():
    problem, _ = scenes.problem()
    broken = jax.tree.map(lambda c: c.at[0, 0, 0].set(jnp.nan), problem.captures)
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    outcome = few(broken, image=jnp.zeros(problem.image_shape))
    assert bool(jnp.isfinite(outcome.image).all()) and outcome.status == "non_finite"
