r"""A deconvolution in units in which a gradient step of length 1 is right."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.imaging.operators.base import AbstractOperator
from thincam_jax.reconstruction.normal import or_one, squared_modulus
from thincam_jax.reconstruction.problem import Deconvolution, residuals, uniform_level

# The power method approaches the largest singular value from below.
MARGIN = 1.05
POWER_ITERATIONS = 40


class Seen(AbstractOperator):
    r"""All that is seen of an image: :math:`f \mapsto (\sqrt{w_k}\, H_k f)_k`, batch included."""

    problem: Deconvolution

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.problem.image_shape

    @property
    def out_shape(self) -> tuple[tuple[int, ...], ...]:
        return tuple(c.shape for c in self.problem.captures)

    def __call__(self, image):
        pairs = zip(self.problem.operators, self.problem.weights, strict=True)
        return tuple(jnp.sqrt(w) * operator(image) for operator, w in pairs)

    def adjoint(self, capture):
        parts = zip(self.problem.operators, self.problem.weights, capture, strict=True)
        first, *others = [operator.adjoint(jnp.sqrt(w) * c) for operator, w, c in parts]
        return sum(others, start=first)


class ScaledProblem(eqx.Module):
    r"""A problem with captures of about 1, weights of at most 1, and :math:`\|\sqrt{w}H\| \le 1`.

    The gradient of its misfit then changes by at most as much as the image does (L = 1). τ is
    that of a regulariser with R(sf) = sR(f), as every norm is. Scaling by powers of the units
    makes iterations see the same numbers whatever the units of captures, pixels and weights.

    - `image_unit`: an image of `problem` times this is one of the problem given.
    - `curvature`: L of the problem given, with its margin.
    """

    problem: Deconvolution
    image_unit: Float[Array, ""]
    curvature: Float[Array, ""]

    def __init__(self, problem: Deconvolution):
        # A minimiser does not depend on the units it is sought in, nor its derivatives on theirs.
        fixed = jax.lax.stop_gradient(problem)
        heaviest = or_one(jnp.stack([jnp.max(w) for w in fixed.weights]).max())
        spectra = [jnp.max(jnp.abs(o.spectrum)) for o in fixed.operators]
        strongest = or_one(jnp.stack(spectra).max())
        captured = _root_mean_square(fixed.captures)
        norm = _norm(_divided(fixed, strongest, captured, heaviest))
        operator_unit = strongest * norm
        self.problem = _divided(problem, operator_unit, captured, heaviest)
        self.image_unit = captured / operator_unit
        self.curvature = heaviest * operator_unit**2


def gradient(problem: Deconvolution, image: Float[Array, "*batch channel plane y x"]):
    r"""That of the misfit: :math:`\sum_k H_k^T w_k (H_k f - g_k)`."""
    return pulled_back(problem, residuals(problem, image))


def pulled_back(problem: Deconvolution, differences) -> Float[Array, "*batch channel plane y x"]:
    r""":math:`\sum_k H_k^T w_k d_k`."""
    parts = zip(problem.operators, problem.weights, differences, strict=True)
    first, *others = [operator.adjoint(w * d) for operator, w, d in parts]
    return sum(others, start=first)


def even_image(problem: Deconvolution) -> Float[Array, "*batch channel plane y x"]:
    """The even image that explains the captures best, not below zero: a good start."""
    level = jnp.maximum(uniform_level(problem), 0)[..., None, None, None]
    return jnp.broadcast_to(level, problem.image_shape)


def start_image(
    problem: Deconvolution, image: Float[Array, "..."] | None
) -> Float[Array, "*batch channel plane y x"]:
    """The image given, checked, or the even one."""
    if image is None:
        return _even_image(problem)
    if image.shape != problem.image_shape:
        raise ValueError(
            f"the start image has shape {image.shape}; give (…, channel, plane, y, x) = "
            f"{problem.image_shape}"
        )
    return jnp.asarray(image, problem.captures[0].dtype)


def _divided(problem: Deconvolution, operator_unit, capture_unit, weight_unit) -> Deconvolution:
    spectra = [o.spectrum / operator_unit.astype(o.spectrum.dtype) for o in problem.operators]
    captures = tuple(c / capture_unit for c in problem.captures)
    weights = tuple(w / weight_unit for w in problem.weights)
    tau = problem.tau / weight_unit / operator_unit / capture_unit
    problem = eqx.tree_at(lambda p: [o.spectrum for o in p.operators], problem, spectra)
    return eqx.tree_at(lambda p: (p.captures, p.weights, p.tau), problem, (captures, weights, tau))


def _norm(problem: Deconvolution) -> Float[Array, ""]:
    """‖√w H‖ with its margin, by the power method, at most what the spectra allow."""
    dtype = problem.captures[0].dtype
    found = MARGIN * Seen(problem).norm(iterations=POWER_ITERATIONS, dtype=dtype)
    # Placing on the window and cutting out of it lengthen nothing: the transfer functions bound it.
    power = sum(
        jnp.max(w) * jnp.sum(squared_modulus(o.spectrum), axis=-3)
        for o, w in zip(problem.operators, problem.weights, strict=True)
    )
    return or_one(jnp.minimum(found, jnp.sqrt(jnp.max(power))))


def _root_mean_square(arrays) -> Float[Array, ""]:
    """Of all numbers, without squares of very large or very small ones."""
    largest = or_one(jnp.stack([jnp.max(jnp.abs(a)) for a in arrays]).max())
    means = [jnp.mean((a / largest) ** 2) for a in arrays]
    return or_one(largest * jnp.sqrt(sum(means) / len(means)))


_even_image = jax.jit(even_image)
scaled_problem = jax.jit(ScaledProblem)
