r"""The splitting of ADMM for operators of any structure: dense, separable, sparse, stacked.

.. math:: z = f \;(\text{data}),\quad u = \Psi f \;(TV),\quad w = f \;(f \ge 0)

The differences stop at the border of the field, so that cosine transforms make what ties the three
together diagonal, (μ₁ + μ₂ΨᵀΨ + μ₃)⁻¹. The proximal map of the data is the solution of

.. math:: \Big(\sum_k A_k^T w_k A_k + \mu_1\Big) z = \sum_k A_k^T w_k g_k + \mu_1 q,

which `normal_equations` finds by the structure of the operators.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.reconstruction.normal_equations import AbstractNormal, normal_equations
from thincam_jax.reconstruction.problem import InverseProblem, back_projected
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled import ScaledProblem, or_one
from thincam_jax.reconstruction.splitting import AbstractSplitting, Penalties, State
from thincam_jax.reconstruction.total_variation import TotalVariation


class DirectSplitting(AbstractSplitting):
    """The splitting of a problem with any operators.

    - `normal`: solves the normal equations with the penalty of the data.
    - `pulled`: Σ Aᵀwg.

    Penalties begin at the mean eigenvalue of AᵀwA and seldom have to change. An iteration that
    moves the image by more than the forces on it says that they do, as with captures of hardly any
    noise; balance beyond that makes dense and separable operators up to a hundred times slower.
    """

    settling: ClassVar[float] = 0.6
    problem: InverseProblem
    normal: AbstractNormal
    pulled: Image
    capture_unit: Float[Array, ""]

    def __init__(self, problem: InverseProblem, variation: TotalVariation):
        scaled = ScaledProblem(problem)
        self.problem, self.image_unit = scaled.problem, scaled.image_unit
        self.capture_unit = scaled.capture_unit
        self.pulled = back_projected(self.problem, self.problem.captures)
        self.tau = self.problem.absolute_tau
        self.variation, self.nonnegative = variation, problem.nonnegative
        # The mean eigenvalue of AᵀwA, whose largest is about 1. A matrix that sees a strong uniform
        # background has one large eigenvalue and thousands of small ones, and a penalty near to
        # the large one would hold the image for hundreds of iterations.
        power = (problem.tau_unit**2 / scaled.curvature).astype(self.tau.dtype)
        mean = jax.lax.stop_gradient(or_one(power))
        self.penalties = Penalties(mean, mean, mean)
        self.normal = normal_equations(self.problem, self.penalties.data)

    def with_captures(self, captures: tuple[Float[Array, "..."], ...]):
        pulled = back_projected(self.problem, [c / self.capture_unit for c in captures])
        return eqx.tree_at(lambda s: s.pulled, self, pulled)

    def with_penalties(self, penalties: Penalties):
        normal = self.normal.shifted(penalties.data)
        return eqx.tree_at(lambda s: (s.penalties, s.normal), self, (penalties, normal))

    def settled(self):
        return eqx.tree_at(lambda s: s.normal, self, self.normal.settled())

    def start(self, image: Image):
        return self._images(image / self.image_unit)

    def image(self, state: State):
        image = jnp.maximum(state.image, 0) if self.nonnegative else state.image
        return image * self.image_unit

    def reflected(self, state: State):
        (q,) = state.data
        data = self.normal(self.pulled + self.penalties.data * q, q)
        shrunk = self.variation.shrink(state.slopes, self.tau / self.penalties.variation)
        slopes = tuple(2 * z - s for z, s in zip(shrunk, state.slopes, strict=True))
        allowed = jnp.abs(state.image) if self.nonnegative else state.image
        return State((2 * data - q,), slopes, allowed)

    def nearest(self, target: State):
        (data,) = target.data
        penalties = self.penalties
        total = penalties.data * data + penalties.image * target.image
        total = total + penalties.variation * self.variation.synthesise(target.slopes)
        symbol = _difference_symbol(total.shape[-3:], self.variation.depth_weight, total.dtype)
        smooth = penalties.variation * symbol
        shift = penalties.data + penalties.image
        axes = (-3, -2, -1)
        modes = jax.scipy.fft.dctn(total, axes=axes, norm="ortho") / (smooth + shift)
        return self._images(jax.scipy.fft.idctn(modes, axes=axes, norm="ortho"))

    def _images(self, image) -> State:
        return State((image,), self.variation.analyse(image), image)


def _difference_symbol(shape: tuple[int, ...], depth_weight, dtype) -> Float[Array, "plane y x"]:
    """ΨᵀΨ in the cosine transform: 4 sin²(πk/2n) along each axis, δ² times that between planes."""
    planes, rows, columns = (
        jnp.asarray(4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2, dtype) for n in shape
    )
    depth = depth_weight.astype(dtype) ** 2 * planes
    return depth[:, None, None] + rows[:, None] + columns
