"""The units of gradient methods: ‖√w H‖ at most 1 and near it, the same for every unit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes

from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.reconstruction.problem import gradient, misfit, start_image
from thincam_jax.reconstruction.scaled import ScaledProblem, Seen


def test_the_largest_singular_value_is_just_below_one():
    problem, _ = scenes.problem((11, 9), (8, 7), weights=[0.3, 2.0])
    scaled = ScaledProblem(problem)
    inside = scaled.problem
    pixels = jnp.eye(56).reshape(56, 1, 1, 8, 7)
    columns = [
        np.sqrt(w) * np.asarray(o(pixels)).reshape(56, -1)
        for o, w in zip(inside.operators, inside.weights, strict=True)
    ]
    largest = np.linalg.norm(np.concatenate(columns, axis=1), 2)
    assert 0.94 < largest <= 1
    dense = [
        np.sqrt(w) * np.asarray(o(pixels)).reshape(56, -1)
        for o, w in zip(problem.operators, problem.weights, strict=True)
    ]
    curvature = np.linalg.norm(np.concatenate(dense, axis=1), 2) ** 2
    np.testing.assert_allclose(scaled.curvature * largest**2, curvature, rtol=1e-10)


def test_objectives_differ_by_a_factor_only_and_the_gradient_is_that_of_the_misfit():
    problem, truth = scenes.problem(channels=2, batch=(2,), tau=0.3)
    scaled = ScaledProblem(problem)
    inside = scaled.problem
    unit = scaled.image_unit
    ratios = []
    for image in (truth, 0.3 * truth + 0.1):
        before = np.array(
            [misfit(problem, image), problem.absolute_tau * problem.regulariser(image)]
        )
        small = image / unit
        ratios.append(
            before
            / np.array([misfit(inside, small), inside.absolute_tau * inside.regulariser(small)])
        )
    np.testing.assert_allclose(ratios, np.full_like(ratios, ratios[0][0, 0]), rtol=1e-9)
    wanted = jax.grad(lambda f: jnp.sum(misfit(inside, f)))(truth)
    np.testing.assert_allclose(gradient(inside, truth), wanted, rtol=1e-9, atol=1e-9)


def test_all_that_is_seen_has_its_transpose():
    problem, _ = scenes.problem(planes=2, weights=[0.3, jnp.linspace(0, 1, 29)])
    assert adjoint_error(Seen(problem), jax.random.key(1), dtype=jnp.float64) < 1e-13


@pytest.mark.parametrize("factor", [1e-12, 1e-8, 1e8, 1e12])
def test_no_unit_is_too_large_or_too_small_for_float32(factor):
    plain = ScaledProblem(scenes.single(scenes.problem()[0]))
    other = ScaledProblem(scenes.single(scenes.rescaled(scenes.problem()[0], factor)))
    np.testing.assert_allclose(other.problem.captures[0], plain.problem.captures[0], rtol=1e-5)
    np.testing.assert_allclose(other.problem.absolute_tau, plain.problem.absolute_tau, rtol=1e-5)
    np.testing.assert_allclose(other.image_unit / factor, plain.image_unit, rtol=1e-5)


def test_a_start_of_another_shape_is_refused():
    problem, _ = scenes.problem()
    with pytest.raises(ValueError, match="start image has shape"):
        start_image(problem, jnp.zeros((3, 4)))
