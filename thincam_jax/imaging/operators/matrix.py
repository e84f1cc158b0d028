"""A camera known by its whole matrix."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.checks import Numbers, Shape
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators.base import (
    AbstractPixelMap,
    real_matrix,
    require_shape,
    require_size,
)


class Matrix(AbstractPixelMap):
    r"""A dense matrix between an image and a capture, both read row by row.

    .. math:: g_i = \sum_j H_{ij} f_j

    Column j is the capture of the image pixel j alone, so it may be measured, by points or by
    Hadamard patterns, and need not be shift-invariant, as a PSF must. It takes
    (pixels of the capture) × (pixels of the image) numbers: 64² to 64² in float32 is 67 MB.

    **Arguments**

    - `matrix`: H, (capture pixel, image pixel).
    - `in_shape`, `out_shape`: shapes of the image and of the capture.
    """

    matrix: Float[Array, "i j"]

    def __init__(self, matrix: Numbers, in_shape: Shape, out_shape: Shape):
        self.matrix = real_matrix("matrix", matrix)
        rows, columns = self.matrix.shape
        self.image_shape = require_size("in_shape", in_shape, columns, "columns")
        self.capture_shape = require_size("out_shape", out_shape, rows, "rows")

    def mean_power(self) -> Float[Array, ""]:
        """Mean squared length of a column, exactly."""
        return jnp.sum(self.matrix**2) / self.matrix.shape[1]

    # On a CPU, XLA sums a transposed matrix with strides: 300 ms instead of 13 for 4096 × 16384 in
    # float32. Both maps therefore name the axes to be summed and never transpose the matrix.

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        batch = image.shape[: image.ndim - len(self.in_shape)]
        flat = image.reshape(*batch, self.matrix.shape[1])
        sums = (((flat.ndim - 1,), (1,)), ((), ()))
        capture = jax.lax.dot_general(flat, self.matrix, sums, precision="highest")
        return capture.reshape(*batch, *self.out_shape)

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        batch = capture.shape[: capture.ndim - len(self.out_shape)]
        flat = capture.reshape(*batch, self.matrix.shape[0])
        return product(flat, self.matrix).reshape(*batch, *self.in_shape)
