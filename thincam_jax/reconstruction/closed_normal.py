r"""Normal equations :math:`(\sum_k A_k^T w_k A_k + \mu)\, z = b` with solutions in closed form.

Factorisations are not differentiated: derivatives follow from the equation itself
(`jax.lax.custom_linear_solve`), so that equal eigenvalues do no harm.
"""

import abc
import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.precision import product
from thincam_jax.imaging.operators import AbstractOperator, Matrix, ReducedMatrix
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.imaging.operators.reduced import each_times
from thincam_jax.imaging.operators.separable import SeparableModes
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_project,
    back_projected,
    detector_shape,
    forward,
    or_one,
    weighted_mean,
)
from thincam_jax.reconstruction.regularisers import Image


class AbstractNormal(eqx.Module):
    """The normal equations of a problem with a shift μ > 0, prepared for solution."""

    problem: InverseProblem
    shift: Float[Array, ""]

    @abc.abstractmethod
    def solve(self, right: Float[Array, "..."]) -> Float[Array, "..."]:
        """z of a right-hand side b (*batch, channel, plane, y, x)."""

    def solve_captures(self, captures: tuple[Float[Array, "..."], ...]):
        """z of b = Σ Aᵀwg, and ⟨b, z⟩, by which ‖√w(Az − g)‖² + μ‖z‖² is below that of z = 0."""
        right = back_projected(self.problem, captures)
        solution = self.solve(right)
        return solution, jnp.sum(right * solution)

    def shifted(self, shift: Float[Array, ""]) -> "AbstractNormal":
        """These equations with another μ, without repeating what does not depend on it."""
        return replace(self, shift=shift)

    def variance(self) -> Float[Array, "*planes y x"]:
        """The diagonal of (Σ AᵀwA + μ)⁻¹ in the shape of the operators' images."""
        raise ValueError(
            "the variance of each pixel has a closed form for dense matrices, for a ReducedMatrix "
            "and for one separable term with one weight; this problem is none of those"
        )

    def settled(self) -> "AbstractNormal":
        """These equations prepared for hundreds of solutions with one μ."""
        return self

    def __call__(self, right: Float[Array, "..."], guess: Float[Array, "..."]):
        """z of b, differentiable; `guess` is what an iterative solution begins with."""
        del guess
        symmetric = lambda _, b: self.solve(b)  # noqa: E731
        return jax.lax.custom_linear_solve(self.applied, right, symmetric, symmetric=True)

    def applied(self, image: Float[Array, "..."]):
        """(Σ AᵀwA + μ) z."""
        seen = tuple(forward(operator, image) for operator in self.problem.operators)
        return back_projected(self.problem, seen) + self.shift * image


class DenseNormal(AbstractNormal):
    """Solutions by the Cholesky factor of the Gram matrix (pixel, pixel) plus μ."""

    gram: Float[Array, "n n"]
    factor: Float[Array, "n n"]

    def __init__(self, problem: InverseProblem, shift: Float[Array, ""], gram: Float[Array, "n n"]):
        self.problem, self.shift, self.gram = problem, shift, gram
        self.factor = _cholesky(gram, jax.lax.stop_gradient(shift))

    def solve(self, right: Float[Array, "..."]):
        flat = right.reshape(-1, self.gram.shape[0]).T
        return jax.scipy.linalg.cho_solve((self.factor, True), flat).T.reshape(right.shape)

    def shifted(self, shift: Float[Array, ""]):
        return DenseNormal(self.problem, shift, self.gram)

    def variance(self):
        unit = jnp.eye(self.gram.shape[0], dtype=self.gram.dtype)
        root = jax.scipy.linalg.solve_triangular(self.factor, unit, lower=True)
        return jnp.sum(root**2, axis=0).reshape(self.problem.operators[0].in_shape)


class SeparableNormal(AbstractNormal):
    """Solutions by the modes of a separable camera, weight and gain included in their values."""

    modes: SeparableModes

    def solve(self, right: Float[Array, "..."]):
        return by_modes(self.modes, jax.lax.stop_gradient(self.shift), right)

    def variance(self):
        inverse = 1 / (self.modes.values**2 + self.shift)
        return product(product(self.modes.rows**2, inverse), (self.modes.columns**2).T)


class ReducedNormal(AbstractNormal):
    """Solutions by the eigenvectors of a reduced matrix, for any μ."""

    def solve(self, right: Float[Array, "..."]):
        bare, power = self._powers()
        modes = bare.modes(right.reshape(-1, bare.values.size)) / power
        return each_times(bare.vectors, modes).reshape(right.shape)

    def variance(self):
        bare, power = self._powers()
        return jnp.sum(bare.vectors**2 / power, axis=1).reshape(bare.in_shape)

    def settled(self):
        bare, power = self._powers()
        inverse = product(bare.vectors / power, bare.transposed)
        return InverseNormal(self.problem, self.shift, inverse)

    def _powers(self):
        """The operator, and the eigenvalues of the whole, μ included."""
        fixed, shift = jax.lax.stop_gradient((self.problem, self.shift))
        (operator,), (weight,) = fixed.operators, fixed.weights
        bare = without_gain(operator)
        assert isinstance(bare, ReducedMatrix)
        return bare, weight.reshape(()) * (gain_of(operator) * bare.values) ** 2 + shift


class InverseNormal(AbstractNormal):
    """Solutions by the inverse matrix itself: one product each."""

    inverse: Float[Array, "n n"]

    def solve(self, right: Float[Array, "..."]):
        flat = right.reshape(-1, self.inverse.shape[0])
        return each_times(jax.lax.stop_gradient(self.inverse), flat).reshape(right.shape)

    def shifted(self, shift: Float[Array, ""]):
        return ReducedNormal(self.problem, shift)


class LevelledNormal(AbstractNormal):
    r"""Solutions with the uniform background of one capture, from those without one.

    With N = AᵀwA + μ, a = Aᵀw1 and d = N⁻¹a, the image and the background beside the capture's
    weighted mean, for a capture less its mean, are

    .. math:: z = N^{-1} b - c\,d,\qquad c = -\frac{a^T N^{-1} b}{s},\qquad
        s = 1^T w 1 - a^T d = \|\sqrt{w}\,(1 - A d)\|^2 + \mu \|d\|^2

    (Sherman and Morrison). They minimise over z and c together, and s is positive unless an image
    casts a uniform capture. A `lowest` c is exact, too, since the minimum over z is a parabola in
    c.

    - `known`: N. `light`: a. `taken`: d. `size`: s.
    """

    known: AbstractNormal
    light: Image
    taken: Image
    size: Float[Array, "*batch channel 1 1 1"]

    def __init__(self, problem: InverseProblem, known: AbstractNormal):
        self.problem, self.shift, self.known = problem, known.shift, known
        (operator,), (weight,) = problem.operators, problem.weights
        axes = len(detector_shape(operator))
        ones = jnp.ones((1, *operator.out_shape)[-1 - axes :], weight.dtype)
        self.light = back_project(operator, weight * ones)
        self.taken = known(self.light, jnp.zeros_like(self.light))
        left = jnp.sum(weight * (ones - forward(operator, self.taken)) ** 2, tuple(range(-axes, 0)))
        own = known.shift * inner(self.taken, self.taken)
        self.size = or_one(left[..., None, None, None] + own)

    def solve(self, right: Float[Array, "..."]):
        return self.levelled(self.known.solve(right))

    def __call__(self, right: Float[Array, "..."], guess: Float[Array, "..."]):
        return self.levelled(self.known(right, guess))

    def levelled(self, image: Image, lowest: Float[Array, "..."] | float = -math.inf) -> Image:
        """z from N⁻¹b, with a c that is not below the `lowest`."""
        found = jnp.maximum(-inner(self.light, image) / self.size, lowest)
        return image - found * self.taken

    def mean_of(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        """Mean of the capture by its weights, with the axes of c."""
        (operator,), (weight,) = self.problem.operators, self.problem.weights
        axes = len(detector_shape(operator))
        mean = weighted_mean(weight, capture, axes)
        return mean.reshape(*mean.shape[:-axes], 1, 1, 1)

    def shifted(self, shift: Float[Array, ""]):
        return LevelledNormal(self.problem, self.known.shifted(shift))

    def settled(self):
        return replace(self, known=self.known.settled())

    def variance(self):
        known = self.known.variance()
        return known + (self.taken**2 / self.size).reshape(known.shape)


def with_weights(problem: InverseProblem):
    return zip(problem.operators, problem.weights, strict=True)


def without_gain(operator: AbstractOperator) -> AbstractOperator:
    """The operator without the gain that a `ScaledProblem` gave it."""
    return operator.operator if isinstance(operator, Scaled) else operator


def gain_of(operator: AbstractOperator):
    return operator.gain if isinstance(operator, Scaled) else 1.0


@jax.jit
def gram_matrix(problem: InverseProblem) -> Float[Array, "n n"]:
    """Σ AᵀwA; with backgrounds to find, of columns of A less their means by the weights."""
    parts = []
    for operator, weight in with_weights(problem):
        bare, gain = without_gain(operator), gain_of(operator)
        assert isinstance(bare, Matrix)
        matrix = bare.matrix
        if weight.size == 1:
            even = weight.reshape(()) * gain**2
            parts.append(even * product(matrix.T, matrix))
            total, pulled = even * matrix.shape[0], even * jnp.sum(matrix, axis=0)
        else:
            rows = weight.reshape(weight.shape[-len(detector_shape(operator)) :])
            rows = jnp.broadcast_to(rows, detector_shape(operator)).reshape(-1, 1)
            parts.append(gain**2 * product(matrix.T, rows * matrix))
            total, pulled = gain**2 * jnp.sum(rows), gain**2 * jnp.sum(rows * matrix, axis=0)
        if problem.has_background:
            parts.append(-jnp.outer(pulled, pulled) / or_one(total))
    return sum(parts[1:], start=parts[0])


@jax.jit
def _cholesky(gram, shift):
    return jnp.linalg.cholesky(gram + shift * jnp.eye(gram.shape[0], dtype=gram.dtype))


def inner(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Inner product of images of each batch element and channel, with their axes."""
    return jnp.sum(a * b, axis=(-3, -2, -1), keepdims=True)


def by_modes(
    modes: SeparableModes, shift: Float[Array, ""], right: Float[Array, "*batch m n"]
) -> Float[Array, "*batch m n"]:
    """(AᵀA + μ)⁻¹ of an image in the modes of A."""
    inside = product(product(modes.rows.T, right), modes.columns) / (modes.values**2 + shift)
    return modes.image(inside)
