r"""TwIST: two-step iterative shrinking, in its monotone form.

.. math:: f_{n+1} = (1 - \alpha) f_{n-1} + (\alpha - \beta) f_n + \beta\,\Gamma(f_n),\qquad
    \Gamma(f) = \mathrm{prox}_{\tau R}\big(f - \nabla E_{\mathrm{misfit}}(f)\big)

(Bioucas-Dias and Figueiredo, IEEE Trans. Image Process. 16, 2992, 2007, in units in which
‖√w H‖ ≤ 1). With eigenvalues of HᵀwH between ξ and 1, and κ = ξ, the paper's theorem gives the best

.. math:: \hat\rho = \frac{1 - \sqrt\kappa}{1 + \sqrt\kappa},\qquad
    \alpha = \hat\rho^2 + 1,\qquad \beta = \frac{2\alpha}{\xi + 1}.

J. Wu et al. (Light Sci. Appl. 9, 53, 2020) reconstruct single captures of a Fresnel zone aperture
with it and total variation. A two-step image with a higher objective than the last one is replaced
by Γ of that (MTwIST), so that the objective never rises.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction.drive import AbstractMethod, Callback, Outcome, Residuals, drive
from thincam_jax.reconstruction.fista import relative_length
from thincam_jax.reconstruction.problem import Deconvolution, residuals
from thincam_jax.reconstruction.proximal import composite, regulariser_of
from thincam_jax.reconstruction.regulariser import AbstractRegulariser, Parts, no_dual, prox
from thincam_jax.reconstruction.scaled import (
    ScaledProblem,
    pulled_back,
    scaled_problem,
    start_image,
)


class TwoStepState(eqx.Module):
    """The last two images, what the last one differs by from the captures, and its objective."""

    image: Float[Array, "*batch channel plane y x"]
    before: Float[Array, "*batch channel plane y x"]
    differences: tuple[Float[Array, "*batch channel v u"], ...]
    value: Float[Array, "*batch"]
    dual: Parts


class TwoStep(AbstractMethod[TwoStepState]):
    """TwIST for a `Deconvolution`; the arguments are those of `solve_two_step`.

    Of `look`, the primal residual is ‖Γ(f) − f‖/‖Γ(f)‖, zero at a minimum only; the dual one is how
    far the image moved, relative to its length.
    """

    problem: Deconvolution
    scaled: ScaledProblem
    regulariser: AbstractRegulariser
    smallest: Float[Array, ""]
    inner: int = eqx.field(static=True)

    def __init__(
        self,
        problem: Deconvolution,
        *,
        regulariser: AbstractRegulariser | None = None,
        smallest_eigenvalue=1e-4,
        inner: int = 10,
    ):
        smallest = checks.fraction("smallest_eigenvalue", smallest_eigenvalue)
        self.problem = problem
        self.scaled = scaled_problem(problem)
        self.regulariser = regulariser_of(problem, regulariser)
        self.smallest = smallest.astype(problem.captures[0].dtype)
        self.inner = inner

    def start(self, image):
        return _start(self, image)

    def advance(self, state, count):
        return _advance(self, state, count)

    def image(self, state):
        return state.image * self.scaled.image_unit

    def objective(self, image):
        return composite(self.problem, self.regulariser, image)

    def look(self, state):
        state, *numbers = _look(self, state)
        primal, dual = jax.device_get(numbers)
        return state, Residuals(float(primal), float(dual))


def solve_two_step(
    problem: Deconvolution,
    *,
    regulariser: AbstractRegulariser | None = None,
    image: Float[Array, "..."] | None = None,
    iterations: int = 500,
    tolerance: float = 1e-5,
    smallest_eigenvalue=1e-4,
    inner: int = 10,
    look_every: int = 10,
    callback: Callback | None = None,
) -> Outcome:
    """The image that minimises misfit + τR, by monotone TwIST.

    **Arguments**

    - `regulariser`: R; default the problem's total variation.
    - `image`: to start from; default the even image that explains the captures best.
    - `tolerance`: relative length of a step at which to end.
    - `smallest_eigenvalue`: ξ, of what the captures tell of, relative to the largest one. The paper
      advises 1e-4 for a badly conditioned H, 1e-2 for a mildly bad one; a wrong one costs
      iterations, not accuracy.
    - `inner`: iterations of the proximal map where it has no closed form.
    - `look_every`, `callback`: see `drive`.
    """
    method = TwoStep(
        problem, regulariser=regulariser, smallest_eigenvalue=smallest_eigenvalue, inner=inner
    )
    return drive(
        method,
        start_image(problem, image),
        iterations=iterations,
        tolerance=tolerance,
        look_every=look_every,
        callback=callback,
    )


def weights(smallest: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """α and β for eigenvalues between the smallest and 1."""
    root = jnp.sqrt(smallest)
    alpha = ((1 - root) / (1 + root)) ** 2 + 1
    return alpha, 2 * alpha / (smallest + 1)


def two_step(method: TwoStep, state: TwoStepState):
    """The next state, and Γ of the image."""
    problem = method.scaled.problem
    pulled, dual = prox(
        method.regulariser,
        state.image - pulled_back(problem, state.differences),
        problem.tau,
        state.dual,
        nonnegative=problem.nonnegative,
        iterations=method.inner,
    )
    alpha, beta = weights(method.smallest)
    # The rest of the two images is formed from differences: no cancellation near the end.
    wanted = (
        state.image + (alpha - 1) * (state.image - state.before) + beta * (pulled - state.image)
    )
    if problem.nonnegative:
        wanted = jnp.maximum(wanted, 0)
    plain, jumped = (_at(method, state.image, image, dual) for image in (pulled, wanted))
    after = _choose(jumped.value <= state.value, jumped, plain)
    # An inexact proximal map may rise by its error: then the image stays, its dual improves.
    stay = TwoStepState(state.image, state.image, state.differences, state.value, dual)
    return _choose(after.value <= state.value, after, stay), pulled


def _at(method: TwoStep, before, image, dual) -> TwoStepState:
    problem = method.scaled.problem
    differences = residuals(problem, image)
    pairs = zip(problem.weights, differences, strict=True)
    parts = [jnp.sum(w * d**2, axis=(-3, -2, -1)) for w, d in pairs]
    value = sum(parts) / 2 + problem.tau * method.regulariser(image)
    return TwoStepState(image, before, differences, value, dual)


def _choose(better, one: TwoStepState, other: TwoStepState) -> TwoStepState:
    """One or the other, for each member of the batch."""

    def pick(a, b):
        return jnp.where(better.reshape(*better.shape, *(1,) * (a.ndim - better.ndim)), a, b)

    return jax.tree.map(pick, one, other)


@jax.jit
def _start(method: TwoStep, image) -> TwoStepState:
    image = image / method.scaled.image_unit
    return _at(method, image, image, no_dual(method.regulariser, image))


@functools.partial(jax.jit, static_argnames="count")
def _advance(method, state, count: int):
    for _ in range(count):
        state, _ = two_step(method, state)
    return state


@jax.jit
def _look(method, state):
    after, pulled = two_step(method, state)
    primal = relative_length(pulled - state.image, pulled)
    return after, primal, relative_length(after.image - state.image, after.image)
