r"""A problem in units in which a gradient step of length 1 is right."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.imaging.operators import AbstractOperator, CropConvolution, Scaled
from thincam_jax.reconstruction.problem import InverseProblem, back_project, convolutions, see
from thincam_jax.reconstruction.regularisers import Image

# The power method approaches the largest singular value from below.
MARGIN = 1.05
POWER_ITERATIONS = 40


class Seen(AbstractOperator):
    r"""All that is seen of an image: :math:`f \mapsto (\sqrt{w_k}\, A_k f)_k`, batch included."""

    problem: InverseProblem

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.problem.image_shape

    @property
    def out_shape(self) -> tuple[tuple[int, ...], ...]:
        return tuple(c.shape for c in self.problem.captures)

    def __call__(self, image: Image):
        pairs = zip(self.problem.operators, self.problem.weights, strict=True)
        return tuple(jnp.sqrt(w) * see(operator, image) for operator, w in pairs)

    def adjoint(self, capture: tuple[Float[Array, "..."], ...]):
        parts = zip(self.problem.operators, self.problem.weights, capture, strict=True)
        first, *others = [back_project(operator, jnp.sqrt(w) * c) for operator, w, c in parts]
        return sum(others, start=first)


class ScaledProblem(eqx.Module):
    r"""A problem with captures of about 1, weights of at most 1, and :math:`\|\sqrt{w}A\| \le 1`.

    The gradient of its misfit then changes by at most as much as the image does (L = 1). τ is
    that of a regulariser with R(sf) = sR(f), as every norm is. Scaling by powers of the units
    makes iterations see the same numbers whatever the units of captures, pixels and weights.

    - `image_unit`: an image of `problem` times this is one of the problem given; `capture_unit`:
      the same of captures.
    - `curvature`: L of the problem given, with its margin.
    """

    problem: InverseProblem
    image_unit: Float[Array, ""]
    capture_unit: Float[Array, ""]
    curvature: Float[Array, ""]

    def __init__(self, problem: InverseProblem):
        # A minimiser does not depend on the units it is sought in, nor its derivatives on theirs.
        operator_unit, captured, heaviest = _units(jax.lax.stop_gradient(problem))
        self.problem = _divided(problem, operator_unit, captured, heaviest)
        self.image_unit, self.capture_unit = captured / operator_unit, captured
        self.curvature = heaviest * operator_unit**2


@jax.jit
def _units(problem: InverseProblem):
    """Of operators, captures and weights."""
    heaviest = or_one(jnp.stack([jnp.max(w) for w in problem.weights]).max())
    strongest = or_one(jnp.stack([_strength(o) for o in problem.operators]).max())
    captured = _root_mean_square(problem.captures)
    norm = _norm(_divided(problem, strongest, captured, heaviest))
    return strongest * norm, captured, heaviest


def or_one(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """A divisor: the value where it is positive, else 1."""
    return jnp.where(value > 0, value, 1)


def _strength(operator: AbstractOperator) -> Float[Array, ""]:
    """A first idea of ‖A‖, which keeps squares within the range of the precision."""
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
    """An operator times a number; what is large, such as a dense matrix, is not copied."""
    if isinstance(operator, CropConvolution):
        spectrum = operator.spectrum * factor.astype(operator.spectrum.dtype)
        return eqx.tree_at(lambda o: o.spectrum, operator, spectrum)
    return Scaled(operator, factor)


def _norm(problem: InverseProblem) -> Float[Array, ""]:
    """‖√w A‖ with its margin, by the power method, at most what the spectra allow."""
    dtype = problem.captures[0].dtype
    (first, *others), (weight, *_) = problem.operators, problem.weights
    if not others and weight.size == 1:  # of one image, and of an operator that may know it
        found = jnp.sqrt(weight.reshape(())) * first.norm(iterations=POWER_ITERATIONS, dtype=dtype)
    else:
        found = Seen(problem).norm(iterations=POWER_ITERATIONS, dtype=dtype)
    found = MARGIN * found
    operators = convolutions(problem)
    if operators is None:
        return or_one(found)
    # Placing on the window and cutting out of it lengthen nothing: the transfer functions bound it.
    power = sum(
        jnp.max(w) * jnp.sum(o.spectrum.real**2 + o.spectrum.imag**2, axis=-3)
        for o, w in zip(operators, problem.weights, strict=True)
    )
    return or_one(jnp.minimum(found, jnp.sqrt(jnp.max(power))))


def _root_mean_square(arrays) -> Float[Array, ""]:
    """Of all numbers, without squares of very large or very small ones."""
    largest = or_one(jnp.stack([jnp.max(jnp.abs(a)) for a in arrays]).max())
    means = [jnp.mean((a / largest) ** 2) for a in arrays]
    return or_one(largest * jnp.sqrt(sum(means) / len(means)))
