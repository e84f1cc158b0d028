"""A measured matrix of many more rows than columns, reduced once for all reconstructions."""

import hashlib
import io
import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray

from thincam_jax._core.checks import Shape
from thincam_jax._core.files import read_arrays, write_whole
from thincam_jax._core.precision import product
from thincam_jax._core.text import of_error
from thincam_jax.imaging.operators.base import (
    AbstractOperator,
    real_numbers,
    require_shape,
    require_size,
)
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.imaging.operators.matrix import Matrix, Sparse

# Numbers of H in the memory at a time: 128 MB in float32.
_BLOCK = 2**25
# Rows of H by which a file is compared with it.
_PROBES = 16


class ReducedMatrix(AbstractOperator):
    r"""A tall matrix H = U S Vᵀ (capture pixel, image pixel) without U: n rows for n columns.

    .. math:: \tfrac12\|Hf - g\|^2 = \tfrac12\|S V^T f - U^T g\|^2 + \text{const},\qquad
        U^T g = S^{-1} V^T (H^T g)

    so that captures Uᵀg of n numbers, which `project` makes, stand for those of all the pixels:
    white noise on g is white on Uᵀg with the same variance, and τ and ridge mean the same. S² and V
    are the eigenvalues and eigenvectors of the Gram matrix HᵀH, which is summed over blocks of
    rows; H itself may stay on the disk. They solve the normal equations with any penalty at the
    cost of two products with V.

    Singular values below about √(√n ε) of the largest, 0.3 % for 4096 columns in float32, are lost
    in the rounding of HᵀH; they count as 0, like the null space of the camera.

    `ReducedMatrix.of` makes one and `load` reads it again.

    - `values`: S. `vectors`: V, an eigenvector a column. `transposed`: Vᵀ, for speed.
    """

    values: Float[Array, " n"]
    vectors: Float[Array, "n n"]
    transposed: Float[Array, "n n"]
    image_shape: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, matrix: Any, in_shape: Shape | None = None) -> "ReducedMatrix":
        """Reduced form of H: `Matrix`, `Sparse`, one `Scaled` (`ScreenFit.system`), or an
        array to be sliced by rows (NumPy, Zarr, SciPy's CSR).

        Takes 2·rows·n² + 25·n³ operations once: minutes for 193600 × 4096 on two cores, in 1 GB
        beside H.

        - `in_shape`: shape of the image; operators know it.

        **Errors**: ValueError where H is no table of finite numbers, or of another width.
        """
        rows = _rows(matrix)
        shape = matrix.in_shape if isinstance(matrix, AbstractOperator) else in_shape
        image_shape = require_size("in_shape", shape, rows.shape[1], "columns")
        squares, vectors = jnp.linalg.eigh(_gram(rows))
        limit = math.sqrt(len(squares)) * jnp.finfo(squares.dtype).eps * squares[-1]
        values = jnp.sqrt(jnp.where(squares > limit, squares, 0))
        return cls(values, vectors, vectors.T, image_shape)

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.image_shape

    @property
    def out_shape(self) -> tuple[int, ...]:
        return self.values.shape

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        batch = image.shape[: image.ndim - len(self.in_shape)]
        return self.values * self.modes(image.reshape(*batch, self.values.size))

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        flat = each_times(self.vectors, self.values * capture)
        return flat.reshape(*capture.shape[:-1], *self.in_shape)

    def modes(self, flat: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        """Vᵀf of images as rows of pixels."""
        return each_times(self.transposed, flat)

    def _norm(self, iterations: int, key: PRNGKeyArray | None, dtype: DTypeLike | None):
        """The largest singular value, exactly."""
        return jnp.max(self.values).astype(dtype or self.values.dtype)

    def mean_power(self) -> Float[Array, ""]:
        """Mean squared length of a column of H, exactly."""
        return jnp.mean(self.values**2)

    def project(self, matrix: Any, captures: Any) -> Float[Array, "*batch n"]:
        """Uᵀg of captures g by H, its rows read once for all of them.

        - `captures`: (*batch, y, x) or (*batch, pixel), as many pixels as H has rows.

        **Errors**: ValueError, one line, for other numbers of pixels or columns.
        """
        if isinstance(matrix, AbstractOperator):
            rows, (count, columns) = matrix, map(math.prod, (matrix.out_shape, matrix.in_shape))
        else:
            rows = _rows(matrix)
            count, columns = rows.shape
        if columns != self.values.size:
            raise ValueError(
                f"the matrix has {columns} columns and was reduced from {self.values.size}; give "
                "the one that it was reduced from"
            )
        shape = np.shape(captures)
        axes = next((k for k in (2, 1) if math.prod(shape[-k:]) == count and len(shape) >= k), 0)
        if not axes:
            raise ValueError(
                f"captures have shape {shape} and the matrix {count} rows; give captures of "
                f"{count} pixels, (…, y, x), of the sensor that the matrix was measured with"
            )
        flat = jnp.asarray(captures, self.values.dtype).reshape(-1, count)
        modes = self.modes(_pulled(rows, flat))
        seen = self.values > 0
        projected = jnp.where(seen, modes / jnp.where(seen, self.values, 1), 0)
        return projected.reshape(*shape[:-axes], columns)

    def save(self, path: str | os.PathLike[str], matrix: Any) -> Path:
        """Write it to a file, with a checksum of its matrix H."""
        file = io.BytesIO()
        np.savez(
            file,
            values=self.values,
            vectors=self.vectors,
            in_shape=self.image_shape,
            mark=_mark(_rows(matrix)),
        )
        return write_whole(path, file.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str], matrix: Any) -> "ReducedMatrix":
        """Read what `save` has written for the same H.

        **Errors**: ValueError, one line, where the file belongs to a matrix of another size or with
        other numbers (16 rows are compared), or is damaged.
        """
        rows, size = _rows(matrix), _rows(matrix).shape[1]
        again = f"make it anew with ReducedMatrix.of and save it as {path}"
        try:
            file = read_arrays(path)
            mark, shape = str(file["mark"]), tuple(int(n) for n in file["in_shape"])
            values, vectors = file["values"], file["vectors"]
        except OSError:
            raise
        except Exception as error:  # of many kinds
            raise ValueError(f"{path} is no reduced matrix ({of_error(error)}); {again}") from error
        if mark != _mark(rows):
            raise ValueError(f"{path} belongs to another matrix than the one given; {again}")
        shapes, kinds = (values.shape, vectors.shape, math.prod(shape)), {values.dtype.kind, "f"}
        sound = shapes == ((size,), (size, size), size) and kinds == {vectors.dtype.kind}
        sound = sound and np.isfinite(vectors).all() and ((values >= 0) & (values < np.inf)).all()
        if not sound:
            raise ValueError(f"{path} holds other shapes, or wrong numbers; {again}")
        return cls(jnp.asarray(values), jnp.asarray(vectors), jnp.asarray(vectors.T), shape)


def each_times(matrix: Float[Array, "n n"], flat: Float[Array, "*batch n"]):
    """The product of a matrix with each vector of a batch.

    On a CPU, XLA is up to 15 times slower for a product with a transposed array: vectors are
    therefore stacked as columns and separated again, not transposed.
    """
    vectors = flat.reshape(-1, flat.shape[-1])
    columns = product(matrix, jnp.stack(list(vectors), axis=-1))
    return jnp.stack([columns[:, k] for k in range(len(vectors))]).reshape(flat.shape)


def _rows(matrix: Any) -> Any:
    """H as an array with a shape, whose rows can be sliced."""
    if isinstance(matrix, Matrix):
        return matrix.matrix
    if isinstance(matrix, Sparse):
        return matrix.by_rows()
    if isinstance(matrix, Scaled):
        rows = _rows(matrix.operator)
        gain = np.broadcast_to(matrix.gain, matrix.out_shape).ravel().astype(rows.dtype)
        return scipy.sparse.diags_array(gain) @ rows
    if len(getattr(matrix, "shape", ())) != 2 or 0 in matrix.shape:
        raise ValueError(
            f"the matrix is a {type(matrix).__name__} of shape {getattr(matrix, 'shape', None)}; "
            "give rows (capture pixel) and columns (image pixel)"
        )
    return matrix


def _blocks(rows: Any):
    """(slice, numbers) of H, some rows at a time; whole chunks of a Zarr array."""
    chunk = (getattr(rows, "chunks", None) or (1,))[0]
    step = max(1, _BLOCK // rows.shape[1] // chunk) * chunk
    for first in range(0, rows.shape[0], step):
        part = slice(first, min(first + step, rows.shape[0]))
        yield part, jnp.asarray(rows[part])


def _gram(rows: Any) -> Float[Array, "n n"]:
    """HᵀH, which shows numbers that are not finite."""
    if scipy.sparse.issparse(rows):
        return real_numbers("HᵀH", (rows.T @ rows).toarray())
    total = jnp.zeros((rows.shape[1],) * 2, real_numbers("the matrix", rows[0:1]).dtype)
    for _, block in _blocks(rows):
        total = _added(total, block)
    return real_numbers("HᵀH", total)


def _pulled(rows: Any, flat: Float[Array, "batch i"]) -> Float[Array, "batch n"]:
    """Hᵀg of each capture."""
    if isinstance(rows, AbstractOperator):
        shape = rows.out_shape
        return rows.adjoint(flat.reshape(-1, *shape)).reshape(len(flat), -1)
    if scipy.sparse.issparse(rows):
        return jnp.asarray((rows.T @ np.asarray(flat).T).T, flat.dtype)
    total = jnp.zeros((len(flat), rows.shape[1]), flat.dtype)
    for part, block in _blocks(rows):
        total = total + product(flat[:, part], block.astype(flat.dtype))
    return total


@jax.jit
def _added(total, block):
    block = block.astype(total.dtype)
    return total + product(block.T, block)


def _mark(rows: Any) -> str:
    """A checksum of the size, and of some rows spread over all."""
    digest = hashlib.sha256(repr((*rows.shape, str(rows.dtype))).encode())
    for row in np.linspace(0, rows.shape[0] - 1, _PROBES).astype(int):
        part = rows[int(row) : int(row) + 1]
        dense = part.toarray() if scipy.sparse.issparse(part) else part
        digest.update(np.ascontiguousarray(dense).tobytes())
    return digest.hexdigest()
