"""The inverse problem, and its rescaled form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import dense, scenes

from helpers import count_traces, finite_difference, quick
from thincam_jax.imaging.operators import CropConvolution, Masked, Matrix, Separable, Stacked
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.operators.crop_convolution import kernel_shape, window_shape
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    gradient,
    misfit,
    objective,
    residuals,
    start_image,
    total_misfit,
    total_objective,
    uniform_level,
)
from thincam_jax.reconstruction.scaled_problem import ScaledProblem, WeightedOperator
from thincam_jax.reconstruction.total_variation import TotalVariation

FIELD, SENSORS = (5, 8), ((7, 6), (4, 9))
RNG = np.random.default_rng(2)
WINDOW = tuple(
    max(sizes)
    for sizes in zip(
        *(window_shape(s, FIELD, kernel_shape(s, FIELD)) for s in SENSORS), strict=True
    )
)


def operator(kernel, sensor):
    return CropConvolution(jnp.asarray(kernel), 0.5, sensor, FIELD, summed=1, window=WINDOW)


def example(channels=2, planes=3, kernel_channels=2):
    """Two captures of a batch of two, with weights; and their matrices (channel, pixel, sample)."""
    kernels = [RNG.normal(size=(kernel_channels, planes, *kernel_shape(s, FIELD))) for s in SENSORS]
    captures = [RNG.normal(size=(2, channels, *s)) for s in SENSORS]
    weights = [RNG.uniform(size=(channels, *s)) for s in SENSORS]
    problem = scenes.inverse(
        [operator(k, s) for k, s in zip(kernels, SENSORS, strict=True)],
        [jnp.asarray(c) for c in captures],
        tau=0.3,
        weights=weights,
        regulariser=TotalVariation("anisotropic", depth_weight=0.4),
    )
    matrices = []
    for kernel, sensor in zip(kernels, SENSORS, strict=True):
        wide = np.broadcast_to(kernel, (channels, *kernel.shape[1:]))
        matrices.append(
            np.stack([np.hstack([dense.matrix(k, sensor, FIELD, 0.5) for k in c]) for c in wide])
        )
    return problem, list(zip(matrices, captures, weights, strict=True))


@pytest.mark.parametrize("kernel_channels", quick([1, 2], 0))
def test_the_objective_by_matrices(kernel_channels):
    """Σ ½ w (Hf − g)² and τ TV, of each element of a batch."""
    problem, parts = example(kernel_channels=kernel_channels)
    assert problem.image_shape == (2, 2, 3, *FIELD)
    image = RNG.normal(size=problem.image_shape)
    psi = dense.slopes((3, *FIELD), 0.4)
    values, gaps = objective(problem, jnp.asarray(image)), residuals(problem, jnp.asarray(image))
    for n in range(2):
        flat = image[n].reshape(2, -1)
        mine = [(a, g[n].reshape(2, -1), w.reshape(2, -1)) for a, g, w in parts]
        expected = dense.objective(flat, mine, 0.3, psi, "anisotropic", False)
        assert float(values[n]) == pytest.approx(expected, rel=1e-12)
        for (a, g, _), gap in zip(mine, gaps, strict=True):
            difference = np.einsum("cps,cs->cp", a, flat) - g
            np.testing.assert_allclose(gap[n].reshape(2, -1), difference, atol=1e-12)


def test_the_uniform_image_is_the_best_of_all_uniform_ones():
    """Of each channel and batch element: the misfit has no slope there, and rises on both sides."""
    problem, _ = example()
    level = uniform_level(problem)
    assert level.shape == (2, 2)

    def cost(levels):
        even = levels[..., None, None, None]
        return jnp.sum(misfit(problem, jnp.broadcast_to(even, problem.image_shape)))

    both = jax.jit(jax.value_and_grad(cost))
    lowest, slope = both(level)
    np.testing.assert_allclose(slope, 0, atol=1e-10)
    for sign in (-1, 1):
        assert float(both(level + 0.1 * sign)[0]) > float(lowest)
    # without light there is none
    dark = InverseProblem(
        [operator(np.zeros((1, 1, *kernel_shape(SENSORS[0], FIELD))), SENSORS[0])],
        [jnp.ones((1, *SENSORS[0]))],
        tau=0.0,
    )
    np.testing.assert_array_equal(uniform_level(dark), [0.0])


def test_gradient_and_traces():
    """Of the objective with respect to τ, image and captures; once compiled."""
    problem, _ = example()
    image = jnp.asarray(RNG.normal(size=problem.image_shape))
    slope = jnp.asarray(RNG.normal(size=image.shape))

    both = jax.jit(jax.value_and_grad(total_objective))
    expected = finite_difference(lambda image: both(image, problem)[0], image, slope, 1e-5)
    np.testing.assert_allclose(np.vdot(both(image, problem)[1], slope), expected, rtol=1e-8)
    counted = count_traces(objective)
    compiled = jax.jit(counted)
    for factor in (1.0, 3.0):
        value = compiled(scenes.rescaled(problem, factor), factor * image)
    np.testing.assert_allclose(value, 9 * objective(problem, image), rtol=1e-10)
    assert counted.traces == 1


def test_stacks_masks_and_gains_are_resolved():
    """What is inside stays as it is; masked pixels, NaN too, leave the objective with its slope."""
    shape, pixels = (4, 3), 10
    dense_matrix = RNG.normal(size=(pixels, 12))
    left, right = RNG.normal(size=(5, 4)), RNG.normal(size=(2, 3))
    inner = Matrix(dense_matrix, shape, (pixels,)), Separable(left, right)
    valid, gain = RNG.uniform(size=pixels) < 0.7, RNG.uniform(0.5, 2.0, size=(5, 2))
    gain[2, 1] = 0.0
    stack = Stacked([Masked(inner[0], valid), Scaled(inner[1], gain)])
    captures = [RNG.normal(size=(3, pixels)), RNG.normal(size=(3, 5, 2))]
    matrices = [dense_matrix[valid], gain.reshape(-1, 1) * np.kron(left, right)]
    spoilt = np.where(valid, captures[0], np.nan)
    problem = InverseProblem(stack, [spoilt, captures[1]], weights=[1.0, 0.5], tau=0.0)
    assert problem.operators == inner and problem.image_shape == (3, 1, *shape)
    image = jnp.asarray(RNG.normal(size=problem.image_shape))
    flat = np.asarray(image).reshape(3, -1)
    seen = [captures[0][:, valid], captures[1].reshape(3, -1)]
    seen[1][:, gain.ravel() == 0] = 0.0
    gaps = [flat @ m.T - g for m, g in zip(matrices, seen, strict=True)]
    expected = (gaps[0] ** 2).sum() / 2 + 0.5 * (gaps[1] ** 2).sum() / 2
    assert float(jax.jit(total_objective)(image, problem)) == pytest.approx(expected, rel=1e-12)
    slope = jax.jit(jax.grad(total_misfit))(image, problem)
    np.testing.assert_allclose(gradient(problem, image), slope, rtol=1e-12, atol=1e-12)
    # and where the mask stands before the stack, with the captures as its own tuple
    masks = (valid, gain > 0)
    whole = InverseProblem(Masked(stack, masks), [(spoilt, captures[1])], weights=[(1.0, 0.5)])
    assert float(jax.jit(total_misfit)(image, whole)) == pytest.approx(expected, rel=1e-12)


def test_what_is_refused():
    kernel = RNG.uniform(size=(1, 1, *kernel_shape(SENSORS[0], FIELD)))
    first = operator(kernel, SENSORS[0])
    second = operator(RNG.uniform(size=(1, 1, *kernel_shape(SENSORS[1], FIELD))), SENSORS[1])
    planes = operator(np.repeat(kernel, 2, axis=1), SENSORS[0])
    coloured = operator(np.repeat(kernel, 3, axis=0), SENSORS[0])
    a, b = jnp.ones((1, *SENSORS[0])), jnp.ones((1, *SENSORS[1]))
    for operators, captures, settings, message in (
        ([first], [a, b], {}, "2 captures for 1 operators; give one operator for each"),
        ([], [], {}, "0 captures for 0 operators"),
        ([first, planes], [a, a], {}, r"shapes \[\(1, 5, 8\), \(2, 5, 8\)\]; they see one image"),
        (
            [first],
            [b],
            {},
            r"a capture has shape \(1, 4, 9\); its operator takes \(…, channel, 7, 6\)",
        ),
        ([first], [a[0]], {}, r"a capture has shape \(7, 6\)"),
        ([coloured], [a], {}, "1 channels and its PSF 3; give a PSF of 1 channel or of as many"),
        ([first, second], [a, jnp.ones((3, 4, 9))], {}, r"captures differ in batch .*\(1,\), \(3,"),
        ([first], [a], {"weights": [1.0, 1.0]}, "2 weights for 1 captures; give one for each"),
        ([first], [a], {"tau": -1.0}, "tau = -1.0 is negative; give tau >= 0"),
        ([Matrix(np.ones((6, 4)), (4,), (6,))], [jnp.ones((1, 6))], {}, r"in_shape \(y, x\), \(pl"),
    ):
        with pytest.raises(ValueError, match=message):
            InverseProblem(operators, captures, **({"tau": 1.0} | settings))


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
    wanted = jax.jit(jax.grad(total_misfit))(truth, inside)
    np.testing.assert_allclose(gradient(inside, truth), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("factor", [1e-12, 1e12])
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


def test_all_that_is_seen_has_its_transpose():
    problem, _ = scenes.problem(planes=2, weights=[0.3, jnp.linspace(0, 1, 29)])
    assert adjoint_error(WeightedOperator(problem), jax.random.key(1), dtype=jnp.float64) < 1e-13
