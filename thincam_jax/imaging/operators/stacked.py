"""Several captures of one image."""

from collections.abc import Sequence

from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray, PyTree

from thincam_jax._core.arguments import checked
from thincam_jax.imaging.operators.base import AbstractOperator, Shapes


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
