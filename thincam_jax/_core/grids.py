"""Sampling grids: where the samples of a plane lie, and their spatial frequencies."""

import functools
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Shape


class Grid(eqx.Module):
    """A rectangular grid centred on the optical axis.

    Sample i of n lies at (i − (n−1)/2)·pitch: +x to the right, +y down. The shape is static, the
    pitch a differentiable array.

    - `shape`: (rows, columns).
    - `pitch`: distance of neighbouring samples, mm, the same in y and x.

    ```python
    import thincam_jax as tc

    grid = tc.Grid((3, 4), 0.5)  # rows and columns, mm
    print(grid.x)  # [-0.75 -0.25  0.25  0.75]
    ```

    **See also**: `Sensor`, `psf`.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    pitch: Float[Array, ""]

    def __init__(self, shape: Shape, pitch: Number):
        self.shape = checks.shape2d("shape", shape)
        self.pitch = checks.positive("pitch", pitch, "mm")

    @property
    def y(self) -> Float[Array, " rows"]:
        """Coordinates of the rows, mm."""
        return centred_indices(self.shape[0], self.pitch.dtype) * self.pitch

    @property
    def x(self) -> Float[Array, " columns"]:
        """Coordinates of the columns, mm."""
        return centred_indices(self.shape[1], self.pitch.dtype) * self.pitch

    @property
    def v(self) -> Float[Array, " rows"]:
        """Spatial frequencies of the centred DFT along y, cycles/mm, ascending."""
        return centred_frequencies(self.shape[0], self.pitch)

    @property
    def u(self) -> Float[Array, " columns"]:
        """Spatial frequencies of the centred DFT along x, cycles/mm, ascending."""
        return centred_frequencies(self.shape[1], self.pitch)

    def with_shape(self, shape: tuple[int, int]) -> "Grid":
        """Grid of this pitch with another number of samples."""
        return Grid(shape, self.pitch)


class SparseGrid(Grid):
    """A grid's rows and columns at some of its indices; stands in for a grid in the models.

    - `row_indices`, `column_indices`: i − (n−1)/2, exact.
    """

    row_indices: Float[Array, " rows"]
    column_indices: Float[Array, " columns"]

    def __init__(
        self,
        row_indices: Float[np.ndarray | Array, " rows"],
        column_indices: Float[np.ndarray | Array, " columns"],
        pitch: Float[Array, ""],
    ):
        self.shape = (len(row_indices), len(column_indices))
        self.pitch = pitch
        self.row_indices = jnp.asarray(row_indices, pitch.dtype)
        self.column_indices = jnp.asarray(column_indices, pitch.dtype)

    def refined(self, factor: int) -> "SparseGrid":
        """The `factor` (odd) samples by `factor` of every pixel."""
        inside = np.arange(factor) - factor // 2

        def fine(indices):
            return (indices[:, None] * factor + inside.astype(indices.dtype)).ravel()

        return SparseGrid(fine(self.row_indices), fine(self.column_indices), self.pitch / factor)

    @property
    def y(self) -> Float[Array, " rows"]:
        return self.row_indices * self.pitch

    @property
    def x(self) -> Float[Array, " columns"]:
        return self.column_indices * self.pitch


@functools.partial(jax.jit, static_argnums=(0, 1))
def centred_indices(count: int, dtype: DTypeLike) -> Float[Array, " count"]:
    """i − (n−1)/2 for i = 0 … n−1: whole or half numbers, exact in every precision."""
    return jnp.arange(count, dtype=dtype) - (count - 1) / 2


@functools.partial(jax.jit, static_argnums=0)
def centred_frequencies(count: int, pitch: Float[Array, ""]) -> Float[Array, " count"]:
    """Frequencies of a DFT of `count` samples, zero at index count//2, in cycles/mm."""
    return (jnp.arange(count, dtype=pitch.dtype) - count // 2) / (count * pitch)


def fast_shape(shape: tuple[int, int], *, real: bool = False) -> tuple[int, int]:
    """The smallest shape that holds `shape` and transforms fast."""
    primes = 2 * 3 * 5 if real else 2 * 3 * 5 * 7 * 11  # a size has no other factors
    rows, columns = (next(m for m in itertools.count(n) if pow(primes, 64, m) == 0) for n in shape)
    return rows, columns


def same_parity(shape: Shape, sensor_shape: tuple[int, int]) -> tuple[int, int]:
    """A field's shape, enlarged by at most one pixel to share its centre with the sensor."""
    shape = checks.shape2d("field_shape", shape)
    rows, columns = (n + (n - s) % 2 for n, s in zip(shape, sensor_shape, strict=True))
    return rows, columns


@jax.jit
def cell_overlap(
    x: Float[Array, " n"],
    pitch: Float[Array, ""],
    lower: Float[Array, " cell"],
    upper: Float[Array, " cell"],
) -> Float[Array, "n cell"]:
    """Length of each [x − pitch/2, x + pitch/2] that lies in each [lower, upper]."""
    x = x[:, None]
    above = jnp.minimum(x + pitch / 2, upper)
    below = jnp.maximum(x - pitch / 2, lower)
    return jnp.maximum(above - below, 0.0)


def central_blocks(shape: tuple[int, int], size: int) -> tuple[slice, slice]:
    """The central part of a (y, x) image whose sides are multiples of `size`."""
    starts = [(n % size) // 2 for n in shape]
    rows, columns = (slice(s, s + n - n % size) for s, n in zip(starts, shape, strict=True))
    return rows, columns


def block_sum(image: Any, size: int, dtype: Any = None) -> Any:
    """Sums over size × size blocks of the last two axes, whose lengths are multiples of `size`.

    For NumPy and JAX. `dtype`: type of the sums, by default the one of `sum`. Rows first, which
    leaves little for the slower sum along them.
    """
    *batch, rows, columns = image.shape
    tall = image.reshape(*batch, rows // size, size, columns).sum(axis=-2, dtype=dtype)
    return tall.reshape(*batch, rows // size, columns // size, size).sum(axis=-1, dtype=dtype)


def block_mean(image: Any, size: int) -> Any:
    """Means over size × size blocks; see `block_sum`."""
    return block_sum(image, size) / size**2
