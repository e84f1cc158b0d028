"""What every linear operator of a camera can do."""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

Shapes = PyTree[tuple[int, ...]]


class AbstractOperator(eqx.Module):
    r"""A real linear map A from an image to a capture, and its transpose.

    - `in_shape`: trailing axes of the image.
    - `out_shape`: trailing axes of the capture; a tuple of shapes where `A(image)` is a tuple.

    Both maps take any leading batch axes. The adjoint belongs to the plain sum of products,
    :math:`\langle A f, g\rangle = \langle f, A^T g\rangle`, which `adjoint_error` checks.
    """

    in_shape: eqx.AbstractVar[tuple[int, ...]]
    out_shape: eqx.AbstractVar[Shapes]

    @abc.abstractmethod
    def __call__(self, image: Float[Array, "..."]) -> PyTree[Float[Array, "..."]]:
        """The capture of an image."""

    @abc.abstractmethod
    def adjoint(self, capture: PyTree[Float[Array, "..."]]) -> Float[Array, "..."]:
        """The transposed map, from a capture to an image."""

    def norm(
        self, *, iterations: int = 30, key: PRNGKeyArray | None = None, dtype=None
    ) -> Float[Array, ""]:
        r"""The largest singular value ‖A‖, by power iteration on AᵀA.

        It is approached from below: after 30 iterations to a few per cent where singular values
        crowd at the top, to all digits where the largest stands alone. A step of a gradient method
        should keep a margin.
        """
        start = jax.random.normal(jax.random.key(0) if key is None else key, self.in_shape, dtype)
        # An operator of non-negative numbers, as every PSF is, has a non-negative top vector.
        start = jnp.abs(start)

        def body(_, carry):
            vector, _ = carry
            image = self.adjoint(self(vector))
            size = jnp.sqrt(jnp.sum(image**2))
            return image / jnp.where(size == 0, 1, size), size

        unit = start / jnp.sqrt(jnp.sum(start**2))
        _, squared = jax.lax.fori_loop(0, iterations, body, (unit, jnp.zeros((), start.dtype)))
        return jnp.sqrt(squared)


def adjoint_error(operator: AbstractOperator, key: PRNGKeyArray, *, dtype=None) -> Float[Array, ""]:
    r"""How far an operator's adjoint is from its transpose.

    :math:`|\langle A f, g\rangle - \langle f, A^T g\rangle| / (\|A f\|\,\|g\|)` for white random f
    and g. A right adjoint gives some multiple of the rounding error, a wrong one about
    1/√(numbers in g) or more.
    """
    first, *others = jax.random.split(key, 1 + len(_shapes(operator.out_shape)))
    image = jax.random.normal(first, operator.in_shape, dtype)
    capture = operator(image)
    leaves, structure = jax.tree.flatten(capture)
    noise = [
        jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(others, leaves, strict=True)
    ]
    forward = sum(jnp.vdot(a, b) for a, b in zip(leaves, noise, strict=True))
    backward = jnp.vdot(image, operator.adjoint(jax.tree.unflatten(structure, noise)))
    sizes = [jnp.sqrt(sum(jnp.sum(a**2) for a in arrays)) for arrays in (leaves, noise)]
    scale = math.prod(sizes, start=jnp.ones((), backward.dtype))
    return jnp.abs(forward - backward) / jnp.where(scale == 0, 1, scale)


def _shapes(shape: Shapes) -> list[tuple[int, ...]]:
    """The shapes of a capture, one or many."""
    if all(isinstance(n, int) for n in shape):
        return [tuple(shape)]
    return [s for part in shape for s in _shapes(part)]
