"""Interface of all linear operators of cameras."""

import abc
import math
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray, PyTree

from thincam_jax._core import checks
from thincam_jax._core.module import AnyRank
from thincam_jax._core.precision import flat_root

Shapes = PyTree[tuple[int, ...]]


class AbstractOperator(AnyRank):
    r"""A real linear map A from an image to a capture, and its transpose.

    Both maps take any leading batch axes. The adjoint belongs to the plain sum of products,
    :math:`\langle A f, g\rangle = \langle f, A^T g\rangle`, which `adjoint_error` checks.
    """

    @property
    @abc.abstractmethod
    def in_shape(self) -> tuple[int, ...]:
        """Trailing axes of the image."""

    @property
    @abc.abstractmethod
    def out_shape(self) -> Shapes:
        """Trailing axes of the capture; a tuple of shapes where `A(image)` is a tuple."""

    @abc.abstractmethod
    def __call__(self, image: Float[Array, "..."]) -> PyTree[Float[Array, "..."]]:
        """The capture of an image."""

    @abc.abstractmethod
    def adjoint(self, capture: PyTree[Float[Array, "..."]]) -> Float[Array, "..."]:
        """The transposed map, from a capture to an image."""

    def norm(
        self,
        *,
        iterations: int = 30,
        key: PRNGKeyArray | None = None,
        dtype: DTypeLike | None = None,
    ) -> Float[Array, ""]:
        r"""The largest singular value ‖A‖, by power iteration on AᵀA.

        It is approached from below: after 30 iterations to a few per cent where singular values
        crowd at the top, to all digits where the largest is isolated. A gradient step
        should keep a margin. `dtype`: type of the iteration, by default that of the operator's
        numbers.
        """
        if iterations < 1:
            raise ValueError(f"iterations = {iterations} finds no norm; give at least 1")
        return self._norm(iterations, key, dtype)

    def _norm(self, iterations: int, key: PRNGKeyArray | None, dtype: DTypeLike | None):
        """Value of `norm`; an operator with a norm in closed form overrides it."""
        key = jax.random.key(0) if key is None else key
        # An operator of non-negative numbers, as every PSF is, has a non-negative top vector.
        start = jnp.abs(jax.random.normal(key, self.in_shape, dtype or dtype_of(self)))
        return _power_iteration(self, start, iterations)

    def mean_power(self) -> Float[Array, ""]:
        r"""Mean squared length of a column: what unit noise on the capture becomes in the image.

        :math:`\|A\|_F^2` over the number of columns, from the response to random signs (Hutchinson,
        Commun. Stat. Simul. Comput. 18, 1059, 1989), to a few per cent; exact where documented.
        """
        return _mean_power(self)


class AbstractPixelMap(AbstractOperator):
    """An operator between the pixels of an image and of a capture, both read row by row."""

    image_shape: tuple[int, ...] = eqx.field(static=True)
    capture_shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.image_shape

    @property
    def out_shape(self) -> tuple[int, ...]:
        return self.capture_shape


_PROBES = 16


@eqx.filter_jit
def _mean_power(operator: AbstractOperator) -> Float[Array, ""]:
    dtype = dtype_of(operator)
    signs = jax.random.rademacher(jax.random.key(0), (_PROBES, *operator.in_shape), dtype)
    size = _PROBES * math.prod(operator.in_shape)
    leaves = jax.tree.leaves(operator(signs))
    return jnp.asarray(sum(jnp.sum(leaf**2) for leaf in leaves) / size)


@eqx.filter_jit
def _power_iteration(operator: AbstractOperator, start: Array, iterations: int):
    def body(_, carry):
        vector, _ = carry
        image = operator.adjoint(operator(vector))
        size = _length([image])
        return image / jnp.where(size == 0, 1, size), size

    initial = (start / _length([start]), jnp.zeros((), start.dtype))
    _, squared = jax.lax.fori_loop(0, iterations, body, initial)
    return flat_root(squared)  # the norm of an operator that is zero is at its minimum


def adjoint_error(
    operator: AbstractOperator, key: PRNGKeyArray, *, dtype: DTypeLike | None = None
) -> Float[Array, ""]:
    r"""Distance of an operator's adjoint from its transpose.

    :math:`|\langle A f, g\rangle - \langle f, A^T g\rangle| / (\|A f\|\,\|g\|)` for white random f
    and g. A right adjoint gives some multiple of the rounding error, a wrong one about 1/√(numbers
    in g) or more. `dtype`: type of f, by default that of the operator's numbers.

    **Errors**: ValueError if a map returns another shape than `out_shape` and `in_shape`.
    """
    expected = shapes_of(operator.out_shape)
    first, *others = jax.random.split(key, 1 + len(expected))
    image = jax.random.normal(first, operator.in_shape, dtype or dtype_of(operator))
    capture = operator(image)
    leaves, structure = jax.tree.flatten(capture)
    _require_result("the operator", [leaf.shape for leaf in leaves], expected)
    noise = [
        jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(others, leaves, strict=True)
    ]
    forward = sum(jnp.vdot(a, b, precision="highest") for a, b in zip(leaves, noise, strict=True))
    returned = operator.adjoint(jax.tree.unflatten(structure, noise))
    _require_result("the adjoint", [returned.shape], [operator.in_shape])
    backward = jnp.vdot(image, returned, precision="highest")
    scale = _length(leaves) * _length(noise)
    return jnp.abs(forward - backward) / jnp.where(scale == 0, 1, scale)


def dtype_of(operator: AbstractOperator) -> np.dtype:
    """The real type of an operator's numbers; the default one where it has none."""
    leaves = jax.tree.leaves(eqx.filter(operator, eqx.is_inexact_array))
    return jnp.finfo(leaves[0].dtype).dtype if leaves else jnp.zeros(()).dtype


def is_shape(shape: Shapes) -> TypeGuard[tuple[int, ...]]:
    """Whether it is the shape of one array, not several in a tuple."""
    return all(isinstance(n, int) for n in shape)


def shapes_of(shape: Shapes) -> list[tuple[int, ...]]:
    """The shapes of a capture, one or many."""
    return [shape] if is_shape(shape) else [s for part in shape for s in shapes_of(part)]


def require_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    """Require the trailing axes of the operator."""
    if array.shape[max(0, array.ndim - len(shape)) :] != shape:
        raise ValueError(
            f"{name} has shape {array.shape}; the operator takes {shape}, after any batch axes"
        )


def require_size(name: str, shape: Any, count: int, what: str) -> tuple[int, ...]:
    """Require a shape of `count` numbers; returned as a tuple of ints."""
    try:
        whole = tuple(int(n) for n in shape)
        sound = whole == tuple(shape) and all(n >= 1 for n in whole)
    except (TypeError, ValueError):
        whole, sound = (), False
    if not sound or math.prod(whole) != count:
        raise ValueError(
            f"{name} = {checks.shown(shape)}, but the matrix has {count} {what}; give a tuple of "
            f"whole numbers whose product is {count}"
        )
    return whole


def real_numbers(name: str, value: Any) -> Float[Array, "..."]:
    """Finite floating numbers as an array; whole numbers become floating ones."""
    array = checks.array(name, value, allow_complex=True)
    if jnp.issubdtype(array.dtype, jnp.integer):
        array = checks.as_array(value, floating=True)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(f"{name} holds {array.dtype}; give real numbers")
    if not checks.is_traced(array):
        wrong = array.size - int(np.isfinite(np.asarray(array)).sum())
        if wrong:
            raise ValueError(f"{name} holds {wrong} numbers that are not finite; give finite ones")
    return array


def real_matrix(name: str, value: Any) -> Float[Array, "i j"]:
    """`real_numbers` in rows and columns."""
    matrix = real_numbers(name, value)
    if matrix.ndim != 2 or matrix.size == 0:
        raise ValueError(
            f"{name} has shape {matrix.shape}; give rows (capture) and columns (image)"
        )
    return matrix


def _require_result(who: str, given: list, expected: list) -> None:
    if given != expected:
        raise ValueError(
            f"{who} returns shapes {given}, but in_shape and out_shape announce {expected}"
        )


def _length(arrays: list) -> Float[Array, ""]:
    return flat_root(sum(jnp.sum(a**2) for a in arrays))
