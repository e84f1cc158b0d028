"""A camera whose rows and columns are coded independently."""

import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray

from thincam_jax._core.checks import Numbers
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators.base import AbstractOperator, real_matrix, require_shape


class Separable(AbstractOperator):
    r"""An image between two matrices, one for its rows and one for its columns.

    .. math:: G = L F R^T, \qquad A^T G = L^T G R

    (FlatCam: Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017, Eq 3). The mask is an outer
    product of two sequences. For n×n images and captures, two matrices of n² numbers stand for one
    of n⁴, and a map costs 2n³ products.

    **Arguments**

    - `left`: L, (rows of the capture, rows of the image).
    - `right`: R, (columns of the capture, columns of the image).
    """

    left: Float[Array, "y m"]
    right: Float[Array, "x n"]

    def __init__(self, left: Numbers, right: Numbers):
        self.left, self.right = real_matrix("left", left), real_matrix("right", right)
        if self.left.dtype != self.right.dtype:
            raise TypeError(
                f"left is {self.left.dtype} and right is {self.right.dtype}; give both in one "
                "precision"
            )

    @property
    def in_shape(self) -> tuple[int, int]:
        return self.left.shape[1], self.right.shape[1]

    @property
    def out_shape(self) -> tuple[int, int]:
        return self.left.shape[0], self.right.shape[0]

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        return _between(self.left, image, self.right.T)

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        return _between(self.left.T, capture, self.right)

    def norm(
        self,
        *,
        iterations: int = 30,
        key: PRNGKeyArray | None = None,
        dtype: DTypeLike | None = None,
    ) -> Float[Array, ""]:
        """The largest singular value, exactly: that of `left` times that of `right`.

        The arguments are those of every operator's norm; nothing is iterated here.
        """
        return jnp.linalg.norm(self.left, 2) * jnp.linalg.norm(self.right, 2)

    def mean_power(self) -> Float[Array, ""]:
        """Mean squared length of a column, exactly: that of `left` times that of `right`."""
        columns = self.left.shape[1] * self.right.shape[1]
        return jnp.sum(self.left**2) * jnp.sum(self.right**2) / columns


def _between(left, image, right):
    """left · image · right, in the order of fewer products."""
    (rows, m), (n, columns) = left.shape, right.shape
    if rows * n * (m + columns) <= m * columns * (n + rows):
        return product(product(left, image), right)
    return product(left, product(image, right))
