r"""Solvers of jaxopt for a deconvolution; the only file of this package that imports it."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxopt
from jaxtyping import Array, Float

from thincam_jax.reconstruction.admm import Penalties, Splitting, State, step
from thincam_jax.reconstruction.drive import AbstractMethod, Residuals
from thincam_jax.reconstruction.fista import ProximalStep, relative_length
from thincam_jax.reconstruction.normal import or_one
from thincam_jax.reconstruction.problem import Deconvolution, misfit
from thincam_jax.reconstruction.proximal_minimiser import total_misfit
from thincam_jax.reconstruction.regulariser import AbstractRegulariser, no_dual, prox
from thincam_jax.reconstruction.scaled import ScaledProblem
from thincam_jax.reconstruction.tv_method import (
    AdmmTotalVariation,
    as_residuals,
    step_and_residuals,
)


class JaxoptState(eqx.Module):
    """An image and jaxopt's own state."""

    image: Float[Array, "*batch channel plane y x"]
    inside: Any  # jaxopt.ProxGradState, which is not public


class JaxoptGradient(AbstractMethod[JaxoptState]):
    """`jaxopt.ProximalGradient`, one update an iteration.

    Its only residual is how far the image moved; it stands for both.
    """

    problem: Deconvolution
    scaled: ScaledProblem
    step: ProximalStep

    def start(self, image):
        return _start(self.scaled, self.step, image / self.scaled.image_unit)

    def advance(self, state, count):
        return _advance(self.scaled, self.step, state, count)

    def image(self, state):
        return state.image * self.scaled.image_unit

    def objective(self, image):
        return _objective(self.problem, self.step.regulariser, image)

    def look(self, state):
        after, moved = _look(self.scaled, self.step, state)
        moved = float(moved)
        return after, Residuals(moved, moved)


class Mixing(NamedTuple):
    """How Anderson acceleration mixes the last points of an iteration.

    - `history`: how many points, m ≥ 2; as many copies of the state are kept, twice.
    - `ridge`: added to the Gram matrix of their residuals, relative to its largest entry.
    - `growth`: a mixture is thrown away if its residual is more than this times the last one.
    - `wait`: plain iterations before the history begins, at the start and after each change of the
      penalties. With m they fill the ten iterations between two looks of `drive`, so that nothing
      is mixed as long as penalties change.
    """

    history: int = 5
    ridge: float = 1e-5
    growth: float = 2.0
    wait: int = 5


class AndersonState(eqx.Module):
    r"""A point q of ADMM, in the metric of the penalties: :math:`\sqrt{\mu}\,q`."""

    weighed: State
    inside: Any  # jaxopt.AndersonState, which is not public


class AndersonAdmm(AbstractMethod[AndersonState]):
    r"""ADMM-TV with Anderson acceleration: `jaxopt.AndersonAcceleration`, one update an iteration.

    The next point is T of a mixture of the last m ones,

    .. math:: q^+ = T\Big(\sum_i \alpha_i T(q_i)\Big),\qquad
        \alpha = \arg\min_{\sum \alpha_i = 1} \Big\|\sum_i \alpha_i (T(q_i) - q_i)\Big\|_M

    (Walker and Ni, SIAM J. Numer. Anal. 49, 1715, 2011; for a linear T much like GMRES), and costs
    one T. In the norm of the penalties M no step of ADMM lengthens the residual; a mixture may, and
    is then replaced by plain steps from the last point, so that the iteration cannot blow up.

    Penalties adapt as those of `AdmmTotalVariation`; as T changes with them, mixing begins anew. It
    pays to let them adapt early (`adapt_until` = 30 of 150 iterations) and mix from then on.

    The history holds 2m copies of the state.

    - `penalties`, `relaxation`: see `AdmmTotalVariation`.
    """

    plain: AdmmTotalVariation
    mixing: Mixing = eqx.field(static=True)

    def __init__(
        self,
        problem: Deconvolution,
        *,
        penalties: Penalties | None = None,
        relaxation=1.0,
        mixing: Mixing | None = None,
    ):
        self.plain = AdmmTotalVariation(problem, penalties=penalties, relaxation=relaxation)
        self.mixing = Mixing() if mixing is None else mixing

    def start(self, image):
        return _begin_mixing(self.mixing, self.plain.penalties, self.plain.start(image))

    def advance(self, state, count):
        return _advance_mixing(self.mixing, self._map(), state, count)

    def image(self, state):
        return self.plain.image(_point(self.plain.penalties, state))

    def objective(self, image):
        return self.plain.objective(image)

    def look(self, state):
        """Its residuals are those of ADMM at the mixture."""
        state, numbers = _look_mixing(self.mixing, self._map(), state)
        return state, as_residuals(numbers)

    def adapt(self, state, residuals):
        point = _point(self.plain.penalties, state)
        plain, point = self.plain.adapt(point, residuals)
        if plain is self.plain:
            return self, state
        method = eqx.tree_at(lambda m: m.plain, self, plain)
        return method, _begin_mixing(self.mixing, plain.penalties, point)

    def _map(self) -> "AdmmMap":
        return AdmmMap(self.plain.splitting, self.plain.penalties, self.plain.relaxation)


class AdmmMap(NamedTuple):
    """T, but for the point it is applied to."""

    splitting: Splitting
    penalties: Penalties
    relaxation: Float[Array, ""]


@functools.partial(jax.jit, static_argnames=("iterations", "tolerance", "inner"))
def implicit_minimiser(
    problem: Deconvolution,
    regulariser: AbstractRegulariser,
    image: Float[Array, "*batch channel plane y x"],
    *,
    iterations: int = 500,
    tolerance: float = 1e-8,
    inner: int = 50,
) -> Float[Array, "*batch channel plane y x"]:
    r"""The minimiser of misfit + τR as a differentiable function of the problem.

    `jaxopt.ProximalGradient` run to the end. Its derivative with respect to captures, weights, τ
    and the operators is that of the fixed point f = prox(f − ∇E(f)) (implicit differentiation):
    memory does not grow with `iterations`. It is exact where the proximal map is (sparsity without
    a sign) and the run has converged, and as good as the `inner` iterations are otherwise.

    - `image`: to start from.
    - `tolerance`: length of the last step, in units in which captures are about 1.
    """
    scaled = ScaledProblem(problem)
    solver = _solver(problem.nonnegative, inner, iterations, tolerance)
    start = jax.lax.stop_gradient(image / scaled.image_unit)
    found = solver.run(start, (regulariser, scaled.problem.tau), scaled.problem)
    return found.params * scaled.image_unit


def _solver(nonnegative: bool, inner: int, iterations: int = 1, tolerance: float = 0.0):
    solver = jaxopt.ProximalGradient(
        fun=total_misfit,
        prox=functools.partial(_prox, nonnegative, inner),
        stepsize=1.0,  # of a `ScaledProblem`
        maxiter=iterations,
        tol=tolerance,
    )
    solver.init_state = functools.partial(_init_state, solver.init_state)  # type: ignore
    return solver


def _init_state(given, image, hyperparameters, problem):
    """jaxopt's, with the momentum's t of the image's precision instead of the default one."""
    return given(image, hyperparameters, problem)._replace(t=jnp.ones((), image.dtype))


def _prox(nonnegative: bool, inner: int, image, hyperparameters, scale=1.0):
    regulariser, tau = hyperparameters
    dual = no_dual(regulariser, image)
    return prox(regulariser, image, scale * tau, dual, nonnegative=nonnegative, iterations=inner)[0]


@jax.jit
def _start(scaled: ScaledProblem, step: ProximalStep, image) -> JaxoptState:
    solver = _solver(step.nonnegative, step.inner)
    return JaxoptState(image, solver.init_state(image, None, scaled.problem))


def _update(scaled: ScaledProblem, step: ProximalStep, state: JaxoptState) -> JaxoptState:
    solver = _solver(step.nonnegative, step.inner)
    return JaxoptState(
        *solver.update(state.image, state.inside, (step.regulariser, step.tau), scaled.problem)
    )


@functools.partial(jax.jit, static_argnames="count")
def _advance(scaled, step, state, count: int):
    for _ in range(count):
        state = _update(scaled, step, state)
    return state


@jax.jit
def _look(scaled, step, state):
    after = _update(scaled, step, state)
    return after, relative_length(after.image - state.image, after.image)


@jax.jit
def _objective(problem, regulariser, image):
    return misfit(problem, image) + problem.tau * regulariser(image)


def _anderson(mixing: Mixing, function, ridge, has_aux=False):
    return jaxopt.AndersonAcceleration(
        fixed_point_fun=function, history_size=mixing.history, ridge=ridge, has_aux=has_aux
    )


def _in_precision_of(weighed: State):
    """jaxopt makes its small matrices in the default precision, and mixes with nothing else."""
    return jax.enable_x64(weighed.image.dtype == jnp.float64)


@functools.partial(jax.jit, static_argnames="mixing")
def _begin_mixing(mixing: Mixing, penalties: Penalties, point: State) -> AndersonState:
    weighed = _times(jax.tree.map(jnp.sqrt, penalties), point)
    with _in_precision_of(weighed):
        inside = _anderson(mixing, lambda q: q, 0.0).init_state(weighed)
        inside = inside._replace(iter_num=inside.iter_num - mixing.wait)
        # Python's numbers in it have weak types, which the next state has not: compiled twice.
        strong = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), inside)
    return AndersonState(weighed, strong)


def _mix(mixing: Mixing, t: AdmmMap, state: AndersonState, function, has_aux=False):
    """A mixture and T of it, or what to go on from if it is worse; what else `function` gives."""
    before = state.inside
    with _in_precision_of(state.weighed):
        # jaxopt's ridge is absolute, but residuals become ever smaller.
        ridge = mixing.ridge * or_one(jnp.max(jnp.diagonal(before.residual_gram)))
        solver = _anderson(mixing, function, ridge, has_aux)
        weighed, after = solver.update(state.weighed, before, t)
        extra, after = after.aux, after._replace(aux=None)
        fine = after.error <= mixing.growth * before.error  # false also for what is no number
        weighed = jax.tree.map(functools.partial(jnp.where, fine), weighed, state.weighed)
        count = jnp.where(fine, after.iter_num, jnp.zeros_like(after.iter_num))
        error = jnp.where(fine, after.error, before.error)
    return AndersonState(weighed, after._replace(iter_num=count, error=error)), extra


@functools.partial(jax.jit, static_argnames=("mixing", "count"), donate_argnames="state")
def _advance_mixing(mixing: Mixing, t: AdmmMap, state: AndersonState, count: int):
    for _ in range(count):
        state, _ = _mix(mixing, t, state, _next)
    return state


@functools.partial(jax.jit, static_argnames="mixing")
def _look_mixing(mixing: Mixing, t: AdmmMap, state: AndersonState):
    return _mix(mixing, t, state, _next_and_residuals, has_aux=True)


def _next(weighed: State, t: AdmmMap) -> State:
    point = _divided(t.penalties, weighed)
    return _times(jax.tree.map(jnp.sqrt, t.penalties), step(*t, point))


def _next_and_residuals(weighed: State, t: AdmmMap):
    after, *residuals = step_and_residuals(*t, _divided(t.penalties, weighed))
    return _times(jax.tree.map(jnp.sqrt, t.penalties), after), residuals


def _divided(penalties: Penalties, weighed: State) -> State:
    return _times(jax.tree.map(lambda p: 1 / jnp.sqrt(p), penalties), weighed)


def _times(factors: Penalties, point: State) -> State:
    data = tuple(factors.data * q for q in point.data)
    slopes = tuple(factors.variation * q for q in point.slopes)
    return State(data, slopes, factors.image * point.image)


@jax.jit
def _point(penalties: Penalties, state: AndersonState) -> State:
    return _divided(penalties, state.weighed)
