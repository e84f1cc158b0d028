"""Captures with masked pixels or with a gain, and several captures of one image."""

import abc
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float, PRNGKeyArray, PyTree

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax.imaging.operators.base import (
    AbstractOperator,
    Shapes,
    is_shape,
    real_numbers,
    require_shape,
)


class AbstractAround(AbstractOperator):
    """An operator whose captures are multiplied pixel by pixel."""

    operator: AbstractOperator

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.operator.in_shape

    @property
    def out_shape(self) -> Shapes:
        return self.operator.out_shape

    @abc.abstractmethod
    def _weighted(self, capture: Any) -> Any:
        """Masking, the same on the way back."""

    def __call__(self, image: Float[Array, "..."]) -> PyTree[Float[Array, "..."]]:
        return self._weighted(self.operator(image))

    def adjoint(self, capture: PyTree[Float[Array, "..."]]) -> Float[Array, "..."]:
        _require_capture(capture, self.out_shape)
        return self.operator.adjoint(self._weighted(capture))


@checked
class Masked(AbstractAround):
    r"""An operator whose dead or saturated pixels read zero.

    .. math:: A f = V\,(B f), \qquad A^T g = B^T (V g), \qquad V = \mathrm{diag}(v)

    The value of a masked pixel, even NaN, is ignored.

    **Arguments**

    - `operator`: B.
    - `valid`: v, booleans that broadcast to `out_shape`, True where a pixel counts. Where the
      capture is a tuple: a tuple of masks, or one for all.
    """

    valid: PyTree[Bool[Array, "..."]]

    def __init__(self, operator: AbstractOperator, valid: PyTree[Numbers]):
        self.operator = operator
        self.valid = _per_capture("valid", valid, operator.out_shape, _boolean)

    def _weighted(self, capture: Any) -> Any:
        return jax.tree.map(lambda part, valid: jnp.where(valid, part, 0), capture, self.valid)


@checked
class Scaled(AbstractAround):
    r"""An operator whose capture is multiplied by a gain.

    .. math:: A f = c\,(B f), \qquad A^T g = B^T (c\,g)

    The gain may be one number (an exposure), one for each capture or channel, or one for each
    pixel (a flat field, 1/σ of the noise). It is differentiable.

    **Arguments**

    - `operator`: B.
    - `gain`: c, finite numbers that broadcast to `out_shape`. Where the capture is a tuple: a
      tuple of gains, or one for all.
    """

    gain: PyTree[Float[Array, "..."]]

    def __init__(self, operator: AbstractOperator, gain: PyTree[Numbers]):
        self.operator = operator
        if isinstance(gain, tuple | list):
            self.gain = _per_capture("gain", gain, operator.out_shape, real_numbers)
        else:
            # Kept as one number or array, also for several captures.
            self.gain = real_numbers("gain", gain)
            _per_capture("gain", self.gain, operator.out_shape, real_numbers)

    def _norm(self, iterations: int, key: PRNGKeyArray | None, dtype: DTypeLike | None):
        """The largest singular value: |c|·‖B‖ where c is one number, else by power iteration."""
        if isinstance(self.gain, tuple) or self.gain.ndim > 0:
            return super()._norm(iterations, key, dtype)
        norm = self.operator.norm(iterations=iterations, key=key, dtype=dtype)
        return jnp.abs(self.gain).astype(norm.dtype) * norm

    def _weighted(self, capture: Any) -> Any:
        if isinstance(self.gain, tuple):
            return jax.tree.map(_times, capture, self.gain)
        return jax.tree.map(lambda part: _times(part, self.gain), capture)


def _times(capture, gain):
    return capture * gain.astype(capture.dtype)


def _boolean(name: str, value) -> Bool[Array, "..."]:
    array = checks.array(name, value)
    if array.dtype != jnp.bool_:
        raise TypeError(
            f"{name} has dtype {array.dtype}; give booleans, True where a pixel counts (weights "
            "are a gain of Scaled)"
        )
    return array


def _per_capture(name: str, value, shape: Shapes, convert):
    """A value for each array of a capture, each converted, checked against the array's shape."""
    if not is_shape(shape):
        parts = value if isinstance(value, tuple | list) else [value] * len(shape)
        if len(parts) != len(shape):
            raise ValueError(
                f"{name} has {len(parts)} parts; give {len(shape)}, one for each capture, or one "
                "array for all"
            )
        pairs = zip(parts, shape, strict=True)
        return tuple(_per_capture(name, part, own, convert) for part, own in pairs)
    array = convert(name, value)
    trailing = shape[max(0, len(shape) - array.ndim) :]
    if array.ndim > len(shape) or any(
        a not in (1, n) for a, n in zip(array.shape, trailing, strict=True)
    ):
        raise ValueError(
            f"{name} has shape {array.shape}; give one that broadcasts to the capture's, {shape}"
        )
    return array


def _require_capture(capture, shape: Shapes) -> None:
    """ValueError for a capture of another shape, which would be broadcast silently."""
    if is_shape(shape):
        if isinstance(capture, tuple | list):
            raise ValueError(f"the capture is a tuple of {len(capture)}; give one array")
        return require_shape("capture", capture, shape)
    if not isinstance(capture, tuple | list) or len(capture) != len(shape):
        raise ValueError(f"the operator has {len(shape)} captures; give a tuple of {len(shape)}")
    for part, own in zip(capture, shape, strict=True):
        _require_capture(part, own)


@checked
class Stacked(AbstractOperator):
    r"""Operators of one image, one after the other.

    .. math:: A f = (A_1 f, \dots, A_K f), \qquad A^T (g_1, \dots, g_K) = \sum_k A_k^T g_k

    Two distances, or a set of zone plates, solved for one image. The captures may differ in shape;
    they come as a tuple, each with the image's batch axes.

    **Arguments**

    - `operators`: at least one, all with the same `in_shape`.
    """

    operators: tuple[AbstractOperator, ...]

    def __init__(self, operators: Sequence[AbstractOperator]):
        self.operators = tuple(operators)
        if not self.operators:
            raise ValueError("operators is empty; give at least one operator")
        shapes = [operator.in_shape for operator in self.operators]
        if any(shape != shapes[0] for shape in shapes):
            raise ValueError(
                f"operators take images of shapes {shapes}; give operators of one in_shape"
            )

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.operators[0].in_shape

    @property
    def out_shape(self) -> Shapes:
        return tuple(operator.out_shape for operator in self.operators)

    def __call__(self, image: Float[Array, "..."]) -> tuple:
        """The captures of an image, one for each operator."""
        return tuple(operator(image) for operator in self.operators)

    def adjoint(self, capture: PyTree[Float[Array, "..."]]) -> Float[Array, "..."]:
        """The sum of all operators' adjoints, each of its own capture."""
        if not isinstance(capture, tuple | list) or len(capture) != len(self.operators):
            given = f"{len(capture)}" if isinstance(capture, tuple | list) else "one array"
            raise ValueError(
                f"the operators' captures are {given}; give a tuple of {len(self.operators)}"
            )
        first, *others = zip(self.operators, capture, strict=True)
        total = first[0].adjoint(first[1])
        for operator, part in others:
            total = total + operator.adjoint(part)
        return total

    def _norm(self, iterations: int, key: PRNGKeyArray | None, dtype: DTypeLike | None):
        """The largest singular value: by power iteration, but of one operator its own."""
        if len(self.operators) == 1:
            return self.operators[0].norm(iterations=iterations, key=key, dtype=dtype)
        return super()._norm(iterations, key, dtype)
