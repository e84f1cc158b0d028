"""A problem in units in which iterations compute the same numbers, whatever its own units are."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.precision import squared_modulus
from thincam_jax.imaging.operators import AbstractOperator, CropConvolution, Separable
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.reconstruction.closed_normal import without_gain
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    convolutions,
    forward,
    or_one,
    without_background,
)
from thincam_jax.reconstruction.regularisers import Image

# The power method approaches the largest singular value from below.
MARGIN = 1.05

POWER_ITERATIONS = 40


class WeightedOperator(AbstractOperator):
    r"""Weighted operators of a problem and its batch, :math:`f \mapsto (\sqrt{w_k}\, A_k f)_k`.

    A_k f is less its weighted mean where there is a background to find, unless it is `whole`.
    """

    problem: InverseProblem
    whole: bool = eqx.field(default=False, static=True)

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.problem.image_shape

    @property
    def out_shape(self) -> tuple[tuple[int, ...], ...]:
        return tuple(c.shape for c in self.problem.captures)

    def __call__(self, image: Image):
        seen = [forward(operator, image) for operator in self.problem.operators]
        known = without_background(self.problem, seen, self._lit)
        return tuple(jnp.sqrt(w) * d for w, d in zip(self.problem.weights, known, strict=True))

    def adjoint(self, capture: tuple[Float[Array, "..."], ...]):
        pairs = zip(self.problem.weights, capture, strict=True)
        differences = [c / jnp.sqrt(or_one(w)) for w, c in pairs]
        return back_projected(self.problem, differences, self._lit)

    @property
    def _lit(self):
        return (jnp.asarray(False),) * len(self.problem.captures) if self.whole else None


class ScaledProblem(eqx.Module):
    r"""A problem rescaled so that the gradient of its misfit has Lipschitz constant 1.

    Captures are about 1, weights at most 1, and :math:`\|\sqrt{w}A\| \le 1`. τ is scaled for a
    regulariser with R(sf) = sR(f), such as a norm. Iterations compute the same numbers in all units
    of captures, pixels and weights.

    - `image_unit`: times this, an image of `problem` is one of the problem given; `capture_unit`:
      factor for captures.
    - `curvature`: Lipschitz constant of the problem given, with a margin.

    Fewer `iterations` of the power method are faster, and ‖√w A‖ may then be somewhat above 1. The
    norm of the `whole` A has the uniform light that a background takes: so has rounding.
    """

    problem: InverseProblem
    image_unit: Float[Array, ""]
    capture_unit: Float[Array, ""]
    curvature: Float[Array, ""]

    def __init__(
        self, problem: InverseProblem, iterations: int = POWER_ITERATIONS, *, whole: bool = False
    ):
        # The minimiser does not depend on these units, nor do its derivatives on theirs.
        fixed = jax.lax.stop_gradient(problem)
        operator_unit, captured, heaviest = _units(fixed, iterations, whole)
        self.problem = _divided(problem, operator_unit, captured, heaviest)
        self.image_unit, self.capture_unit = captured / operator_unit, captured
        self.curvature = heaviest * operator_unit**2


@functools.partial(jax.jit, static_argnames=("iterations", "whole"))
def _units(problem: InverseProblem, iterations: int, whole: bool):
    """Units of operators, captures and weights."""
    heaviest = or_one(jnp.stack([jnp.max(w) for w in problem.weights]).max())
    strongest = or_one(jnp.stack([_strength(o) for o in problem.operators]).max())
    captured = _root_mean_square(problem.captures)
    norm = _norm(_divided(problem, strongest, captured, heaviest), iterations, whole)
    return strongest * norm, captured, heaviest


def _strength(operator: AbstractOperator) -> Float[Array, ""]:
    """A rough estimate of ‖A‖, which keeps squares within the range of the precision."""
    if isinstance(operator, CropConvolution):
        return jnp.max(jnp.abs(operator.spectrum))
    return operator.norm(iterations=3)


def _divided(problem: InverseProblem, operator_unit, capture_unit, weight_unit) -> InverseProblem:
    operators = tuple(_times(o, 1 / operator_unit) for o in problem.operators)
    captures = tuple(c / capture_unit for c in problem.captures)
    weights = tuple(w / weight_unit for w in problem.weights)
    tau_unit = problem.tau_unit / weight_unit / operator_unit / capture_unit
    return eqx.tree_at(
        lambda p: (p.operators, p.captures, p.weights, p.tau_unit),
        problem,
        (operators, captures, weights, tau_unit),
    )


def _times(operator: AbstractOperator, factor) -> AbstractOperator:
    """An operator times a number, without a copy of a dense matrix."""
    if isinstance(operator, CropConvolution):
        spectrum = operator.spectrum * factor.astype(operator.spectrum.dtype)
        return eqx.tree_at(lambda o: o.spectrum, operator, spectrum)
    return Scaled(operator, factor)


def _norm(problem: InverseProblem, iterations: int, whole: bool) -> Float[Array, ""]:
    """‖√w A‖ with a margin, by the power method, at most the bound of the spectra."""
    dtype = problem.captures[0].dtype
    (first, *others), (weight, *_) = problem.operators, problem.weights
    is_known = whole or not problem.has_background or isinstance(without_gain(first), Separable)
    if not others and weight.size == 1 and is_known:  # the operator may know its own norm
        found = jnp.sqrt(weight.reshape(())) * first.norm(iterations=iterations, dtype=dtype)
    else:
        found = WeightedOperator(problem, whole).norm(iterations=iterations, dtype=dtype)
    found = MARGIN * found
    operators = convolutions(problem)
    if operators is None:
        return or_one(found)
    # Placing on the window and cropping have norm 1: the transfer functions bound the norm.
    power = sum(
        jnp.max(w) * jnp.sum(squared_modulus(o.spectrum), axis=-3)
        for o, w in zip(operators, problem.weights, strict=True)
    )
    return or_one(jnp.minimum(found, jnp.sqrt(jnp.max(power))))


def _root_mean_square(arrays) -> Float[Array, ""]:
    """Root mean square of all arrays, without overflow or underflow of squares."""
    largest = or_one(jnp.stack([jnp.max(jnp.abs(a)) for a in arrays]).max())
    means = [jnp.mean((a / largest) ** 2) for a in arrays]
    return or_one(largest * jnp.sqrt(sum(means) / len(means)))
