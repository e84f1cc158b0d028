r"""Ridge (Tikhonov) regression, matrix-free, by conjugate gradients.

.. math:: f = \arg\min_f \tfrac12 \sum_k \|\sqrt{w_k}\,(H_k f - g_k)\|^2
    + \tfrac{\rho}{2}\|f - \bar f\|^2, \qquad
    \Big(\sum_k H_k^T w_k H_k + \rho\Big)(f - \bar f) = \sum_k H_k^T w_k (g_k - H_k \bar f)

It is linear in the captures and knows the crop of the sensor and the weight of every pixel, which a
Wiener filter does not. For Gaussian noise and a white prior it is the mean of the posterior.
"""

import functools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import optimistix
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.reconstruction.drive import Outcome
from thincam_jax.reconstruction.normal import squared_modulus
from thincam_jax.reconstruction.outcome import concluded
from thincam_jax.reconstruction.problem import Deconvolution, misfit, residuals
from thincam_jax.reconstruction.scaled import ScaledProblem, pulled_back, start_image


def solve_ridge(
    problem: Deconvolution,
    *,
    ridge,
    mean: Float[Array, "..."] | None = None,
    iterations: int = 300,
    tolerance: float = 1e-6,
) -> Outcome:
    """The ridge reconstruction of a problem; its τ, TV and sign are not used.

    The image may be negative. One piece of compiled code: there is no progress to be watched.

    **Arguments**

    - `ridge`: ρ > 0, in units of weight × operator²: 1/variance of the image, where the weights are
      1/variance of the noise.
    - `mean`: f̄, what the image is drawn to; default the even image that explains the captures best.
    - `tolerance`: of the residual of the normal equations and of the last step, root mean square,
      relative to the right-hand side and the image.

    The status is "converged" or "iterations_exhausted" as lineax says.
    """
    began = time.perf_counter()
    dtype = problem.captures[0].dtype
    ridge = checks.positive("ridge", ridge, "units of weight times operator squared").astype(dtype)
    mean = start_image(problem, mean)
    limit = jnp.asarray(tolerance, dtype)
    image, done, steps = _solve(problem, ridge, mean, limit, iterations)
    return concluded(
        mean,
        image,
        functools.partial(ridge_objective, problem, ridge, mean),
        converged=bool(done),
        iterations=int(steps),
        began=began,
    )


@jax.jit
def ridge_objective(
    problem: Deconvolution,
    ridge: Float[Array, ""],
    mean: Float[Array, "*batch channel plane y x"],
    image: Float[Array, "*batch channel plane y x"],
) -> Float[Array, "*batch"]:
    """The misfit plus ρ/2 ‖f − f̄‖² of each member of the batch."""
    return misfit(problem, image) + ridge / 2 * jnp.sum((image - mean) ** 2, axis=(-4, -3, -2, -1))


class _Normal(eqx.Module):
    """Σ HᵀwH + ρ, times a factor."""

    problem: Deconvolution
    ridge: Float[Array, ""]
    factor: Float[Array, ""]

    def __call__(self, image):
        seen = tuple(operator(image) for operator in self.problem.operators)
        return self.factor * (pulled_back(self.problem, seen) + self.ridge * image)


class _Preconditioner(eqx.Module):
    """(Σ w̄|Ĥ|² + ρ)⁻¹ on the window, and cut: what the inverse were without the crop.

    Positive definite, since it is a positive filter between a map and its transpose.
    """

    problem: Deconvolution
    ridge: Float[Array, ""]

    def __call__(self, image):
        operator = self.problem.operators[0]
        power = sum(
            jnp.mean(w) * squared_modulus(o.spectrum)
            for o, w in zip(self.problem.operators, self.problem.weights, strict=True)
        )
        field = place(image, operator.field_corner, operator.window)
        filtered = jnp.fft.rfft2(field)
        filtered = filtered / (power + self.ridge).astype(filtered.dtype)
        field = jnp.fft.irfft2(filtered, s=operator.window)
        return cut(field, operator.field_corner, operator.field_shape)


@functools.partial(jax.jit, static_argnames="iterations")
def _solve(problem: Deconvolution, ridge, mean, tolerance, iterations: int):
    scaled = ScaledProblem(problem)
    inside, rho = scaled.problem, ridge / scaled.curvature
    mean = mean / scaled.image_unit
    target = -pulled_back(inside, residuals(inside, mean))
    factor = curvature_scale(target)
    structure = jax.ShapeDtypeStruct(target.shape, target.dtype)
    tags = lineax.positive_semidefinite_tag
    operator = lineax.FunctionLinearOperator(_Normal(inside, rho, factor), structure, tags)
    preconditioner = lineax.FunctionLinearOperator(_Preconditioner(inside, rho), structure, tags)
    size = jnp.sqrt(jnp.mean(target**2))
    solver = lineax.CG(
        rtol=tolerance, atol=tolerance * size, norm=optimistix.rms_norm, max_steps=iterations
    )
    solution = lineax.linear_solve(
        operator, target, solver, options={"preconditioner": preconditioner}, throw=False
    )
    done = solution.result == lineax.RESULTS.successful
    image = (mean + factor * solution.value) * scaled.image_unit
    return image, done, solution.stats["num_steps"]


def curvature_scale(image: Float[Array, "..."]) -> Float[Array, ""]:
    """A factor for quadratic forms that `lineax.CG` is to minimise over images like this.

    lineax takes a curvature pᵀAp/‖r‖² below 100·eps·(number of unknowns) for a breakdown, whatever
    the size of A. In float32 that is 3 for 512² pixels: more than any A of norm 1 has. A is
    therefore multiplied by what leaves room for eigenvalues down to 1e-6.
    """
    eps = float(jnp.finfo(image.dtype).eps)
    return jnp.asarray(max(1.0, 1e8 * eps * image.size), image.dtype)
