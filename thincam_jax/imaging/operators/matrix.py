"""Cameras known by their matrix: all of it, or its few entries."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from thincam_jax._core.checks import Numbers, Shape
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators.base import (
    AbstractPixelMap,
    real_matrix,
    real_numbers,
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


class Sparse(AbstractPixelMap):
    r"""A sparse matrix between an image and a capture, both read row by row.

    .. math:: g_i = \sum_j H_{ij} f_j

    Rays that each meet a few pixels, resampling, a PSF that is compact but changes over the field.

    The entries are kept once, as triples (row, column, value), and both maps add them up where they
    belong. Linear in the values too, and differentiable in them.

    **Arguments**

    - `matrix`: H, (capture pixel, image pixel): a matrix or array of `scipy.sparse`, or a `BCOO` of
      `jax.experimental.sparse` without batch or dense axes. Entries at the same place add up.
    - `in_shape`, `out_shape`: shapes of the image and of the capture.
    """

    values: Float[Array, " entry"]
    rows: Int[Array, " entry"]
    columns: Int[Array, " entry"]

    def __init__(self, matrix: Any, in_shape: Shape, out_shape: Shape):
        self.values, self.rows, self.columns = _entries(matrix)
        self.image_shape = require_size("in_shape", in_shape, matrix.shape[1], "columns")
        self.capture_shape = require_size("out_shape", out_shape, matrix.shape[0], "rows")

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        return _sums(self.values, self.columns, self.rows, image, self.in_shape, self.out_shape)

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        return _sums(self.values, self.rows, self.columns, capture, self.out_shape, self.in_shape)

    def by_rows(self) -> "scipy.sparse.csr_array":
        """H for SciPy, row by row."""
        shape = math.prod(self.out_shape), math.prod(self.in_shape)
        values, rows, columns = (np.asarray(x) for x in (self.values, self.rows, self.columns))
        inside = (rows < shape[0]) & (columns < shape[1])  # those that pad a BCOO are not
        return scipy.sparse.csr_array((values[inside], (rows[inside], columns[inside])), shape)


# Measured for 65536 × 90000 with 3.3 million entries in float32 on 2 CPU cores: 5 to 19 ms a map
# this way, 35 to 65 for the product of a BCOO, whether transposed or not. A second, transposed and
# sorted copy took 9 to 17 for the adjoint, and would double the memory.


@functools.partial(jax.jit, static_argnames=("shape", "result_shape"))
def _sums(values, sources, targets, image, shape, result_shape):
    """result[target] = Σ value · image[source], image by image."""
    batch = image.shape[: image.ndim - len(shape)]
    size = math.prod(result_shape)

    def one(flat):
        products = values * flat.at[sources].get(mode="clip")
        # The entries that pad a BCOO are out of range; they are left out.
        return jnp.zeros(size, products.dtype).at[targets].add(products, mode="drop")

    # One at a time, so that the products of all images and entries never exist together.
    flat = image.reshape(-1, math.prod(shape))
    result = one(flat[0]) if flat.shape[0] == 1 else jax.lax.map(one, flat)
    return result.reshape(*batch, *result_shape)


def _entries(matrix):
    """Values, rows and columns of a sparse matrix."""
    from jax.experimental import sparse  # here, since it takes a tenth of a second

    if isinstance(matrix, sparse.BCOO):
        if matrix.n_batch or matrix.n_dense or matrix.ndim != 2:
            raise ValueError(
                f"matrix is a BCOO of shape {matrix.shape} with {matrix.n_batch} batch and "
                f"{matrix.n_dense} dense axes; give two axes, both sparse"
            )
        values, rows, columns = matrix.data, matrix.indices[:, 0], matrix.indices[:, 1]
    elif scipy.sparse.issparse(matrix):
        if matrix.ndim != 2:
            raise ValueError(f"matrix has shape {matrix.shape}; give rows and columns")
        entries = scipy.sparse.coo_array(matrix)
        values = entries.data
        rows, columns = (jnp.asarray(index, dtype=jnp.int32) for index in entries.coords)
    else:
        raise TypeError(
            f"matrix is a {type(matrix).__name__}; give a scipy.sparse matrix or a BCOO, or use "
            "Matrix for a dense one"
        )
    return real_numbers("matrix", values), rows, columns
