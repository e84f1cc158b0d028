"""Any operator feeds any solver: against a bounded least-squares solution of the dual by SciPy.

Anisotropic total variation and f ≥ 0 make the dual of

    ½ Σ w (Af − g)² + τ‖Df‖₁,  f ≥ 0

a least-squares problem with bounds: f = G⁻¹(b − Dᵀp + λ) with G = AᵀwA = LLᵀ and b = Aᵀwg, where
|p| ≤ τ and λ ≥ 0 minimise ‖L⁻¹(b − Dᵀp + λ)‖. `scipy.optimize.lsq_linear` solves that; it shares
nothing with ADMM, FISTA or conjugate gradients.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
import scipy.linalg
import scipy.optimize
import scipy.sparse
from reconstruction import dense, scenes

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2
from thincam_jax.imaging.operators import (
    AbstractOperator,
    CropConvolution,
    Masked,
    Matrix,
    Separable,
    Sparse,
    Stacked,
)
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.reconstruction import TotalVariation, solve_fixed_point
from thincam_jax.reconstruction.admm import admm_map
from thincam_jax.reconstruction.normal_equations import (
    DenseNormal,
    IterativeNormal,
    SeparableNormal,
)
from thincam_jax.reconstruction.problem import total_objective, uniform_level
from thincam_jax.reconstruction.ridge import image_precision
from thincam_jax.reconstruction.splittings import splitting_of

FIELD = (9, 12)
TAU = 5.0
VARIATION = TotalVariation("anisotropic")


def operators() -> dict[str, AbstractOperator]:
    rng = np.random.default_rng(4)
    pixels = FIELD[0] * FIELD[1]
    few = scipy.sparse.random(200, pixels, 0.1, random_state=2)
    kernel = scenes.spots(kernel_shape((14, 17), FIELD))
    crop = CropConvolution(jnp.asarray(kernel), 0.5, (14, 17), FIELD)
    return {
        "dense": Matrix(rng.normal(size=(900, 400)), (20, 20), (30, 30)),
        "separable": Separable(rng.normal(size=(13, 9)), rng.normal(size=(17, 12))),
        "sparse": Sparse(few + scipy.sparse.eye(200, pixels), FIELD, (10, 20)),
        "stacked": Stacked(
            [
                Matrix(rng.normal(size=(70, pixels)), FIELD, (7, 10)),
                Scaled(Separable(rng.normal(size=(11, 9)), rng.normal(size=(10, 12))), 0.5),
            ]
        ),
        "masked": Masked(crop, rng.random((14, 17)) > 0.1),
        "small": Matrix(rng.normal(size=(70, 30)), (5, 6), (7, 10)),
    }


class Case:
    """A recording of blocks with 2 % of noise, and what SciPy needs of it."""

    def __init__(self, name: str):
        operator = operators()[name]
        rng = np.random.default_rng(8)
        rows, columns = operator.in_shape[-2:]
        # Below zero in places, so that f ≥ 0 matters.
        truth = jax.device_put(scenes.blocks((rows, columns)) - 0.4)
        leaves, structure = jax.tree.flatten(jax.device_get(operator(truth)))
        noise = [0.02 * float(np.std(leaf)) for leaf in leaves]
        noisy = [
            leaf + s * rng.normal(size=leaf.shape) for leaf, s in zip(leaves, noise, strict=True)
        ]
        captures = jax.tree.unflatten(structure, noisy)
        variances = [s**2 for s in noise]
        self.shape = (rows, columns)
        self.recording = tc.Recording(captures, operator, noise_variance=variances, background=0.0)
        self.problem = self.recording.problem(tau=TAU, regulariser=VARIATION)
        basis = jax.device_put(np.eye(rows * columns).reshape(-1, rows, columns))
        seen = jax.tree.leaves(operator(basis))
        matrices = [np.asarray(s).reshape(rows * columns, -1).T for s in seen]
        parts = list(zip(matrices, variances, strict=True))
        self.gram = sum(a.T @ a / v for a, v in parts)
        flat = [np.asarray(g).ravel() for g in noisy]
        self.pulled = sum(a.T @ g / v for (a, v), g in zip(parts, flat, strict=True))

    def minimiser(self) -> np.ndarray:
        """By SciPy, from the dual."""
        tau = float(self.problem.absolute_tau)
        count = len(self.pulled)
        down, right, _ = dense.slopes((1, *self.shape))
        differences = np.concatenate([d[np.abs(d).sum(axis=1) > 0] for d in (down, right)])
        factor = np.linalg.cholesky(self.gram)
        into = functools.partial(scipy.linalg.solve_triangular, factor, lower=True)
        table = np.hstack([tau * into(differences.T), -into(np.eye(count))])
        edges = len(differences)
        low = np.r_[-np.ones(edges), np.zeros(count)]
        high = np.r_[np.ones(edges), np.full(count, np.inf)]
        found = scipy.optimize.lsq_linear(
            table, into(self.pulled), (low, high), method="bvls", tol=1e-15, max_iter=5000
        )
        dual, sign = tau * found.x[:edges], found.x[edges:]
        image = np.linalg.solve(self.gram, self.pulled - differences.T @ dual + sign)
        assert (image > -1e-6 * image.max()).all() and (image < 1e-6 * image.max()).any()
        return image.reshape(self.shape)


case = functools.cache(Case)


@functools.cache
def expected(name: str) -> np.ndarray:
    return case(name).minimiser()


@pytest.mark.parametrize("name", quick(operators(), 5))  # whose minimiser another test needs, too
def test_total_variation_by_admm_and_fista(name):
    """Both are within 1e-6 of the minimiser, and report that they have converged."""
    for solver in (
        tc.AdmmTV(TAU, variation=VARIATION, iterations=6000, tolerance=1e-9),
        tc.Fista(TAU, regulariser=VARIATION, iterations=6000, tolerance=1e-10),
    ):
        found = tc.reconstruct(case(name).recording, solver)
        assert found.image.shape == case(name).shape and found.pitch is None
        assert relative_l2(found.image, expected(name)) < 1e-6, solver.name
        assert found.status == "converged" and float(found.image.min()) >= 0
    # The variation and the sign matter.
    plain = np.linalg.solve(case(name).gram, case(name).pulled).reshape(case(name).shape)
    assert relative_l2(plain, expected(name)) > 1e-2


@pytest.mark.parametrize("name", quick(operators(), 3))  # dense and separable
def test_ridge(name):
    """The posterior mean, by the normal equations as one dense system."""
    given = case(name)
    level = float(uniform_level(given.problem)[0])
    found = tc.reconstruct(given.recording, tc.Ridge(3.0, iterations=2000, tolerance=1e-12))
    precision = 3.0 * image_precision(jnp.asarray(level))
    count = given.gram.shape[0]
    right = given.pulled + precision * max(level, 0.0)  # the mean is not below zero
    wanted = np.linalg.solve(given.gram + precision * np.eye(count), right)
    assert found.status == "converged"
    assert relative_l2(found.image, wanted.reshape(given.shape)) < 1e-6


def test_the_inner_solve_follows_the_structure():
    kinds = {"small": DenseNormal, "separable": SeparableNormal, "sparse": IterativeNormal}
    for name, kind in kinds.items():
        assert type(splitting_of(case(name).problem).normal) is kind
    # A masked convolution keeps its transforms: the mask is a weight.
    assert isinstance(case("masked").problem.operators[0], CropConvolution)
    assert type(splitting_of(case("masked").problem)).__name__ == "FourierSplitting"


@pytest.mark.thorough
def test_solvers_of_optimistix_take_the_problem():
    """LBFGS on a smooth problem, and the fixed point of ADMM's map, reach the same images."""
    given = case("small")
    smooth = given.recording.problem(tau=0.0, nonnegative=False)
    start = jnp.zeros(smooth.image_shape)
    found = optimistix.minimise(
        total_objective, optimistix.LBFGS(1e-13, 1e-13), start, args=smooth, max_steps=2000
    )
    wanted = np.linalg.solve(given.gram, given.pulled).reshape(given.shape)
    assert relative_l2(found.value[0, 0], wanted) < 1e-6

    splitting = splitting_of(given.problem)
    begin = splitting.start(start)
    solver = optimistix.FixedPointIteration(rtol=0.0, atol=1e-11, damp=-0.8)
    solution = optimistix.fixed_point(
        admm_map, solver, begin, args=splitting, max_steps=20_000, throw=False
    )
    assert solution.result == optimistix.RESULTS.successful
    image = splitting.image(solution.value)[0, 0]
    assert relative_l2(image, expected("small")) < 1e-6


@pytest.mark.thorough
def test_implicit_gradients_of_a_dense_operator():
    """Of the image's brightness in a place, by matrix, captures and τ, against differences."""
    rng = np.random.default_rng(1)
    shape = (4, 5)
    matrix = rng.normal(size=(33, 20))
    seen = (matrix @ scenes.blocks(shape).ravel() + 0.1 * rng.normal(size=33)).reshape(3, 11)
    where = rng.normal(size=shape)

    def brightness(given):
        matrix, captures, tau = given
        recording = tc.Recording(captures, Matrix(matrix, shape, (3, 11)), noise_variance=0.01)
        problem = recording.problem(tau=tau)
        start = jnp.zeros(problem.image_shape)
        found = solve_fixed_point(problem, start, iterations=5000, tolerance=1e-12)
        return jnp.vdot(where, found.image[0, 0])

    at = (matrix, seen, np.asarray(1.5))
    both = jax.jit(jax.value_and_grad(brightness))
    slopes = jax.device_get(both(at)[1])
    for index in range(3):
        direction = tuple(
            rng.normal(size=x.shape) if n == index else np.zeros_like(x) for n, x in enumerate(at)
        )
        slope = sum(np.vdot(s, d) for s, d in zip(slopes, direction, strict=True))
        change = finite_difference(lambda x: both(x)[0], at, direction, 1e-4)
        assert float(slope) == pytest.approx(float(change), rel=1e-4)
