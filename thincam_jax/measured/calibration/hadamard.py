r"""Hadamard patterns on a monitor, and their inverse transform (thesis Eq 5.12–5.17).

Every cell of the object is lit in half of the patterns: the noise of the matrix is 2/√N of that of
cells lit one by one. Rows of the Hadamard matrix U′ hold ±1, a monitor shows 0 and 1:

.. math:: \mathbf u' = 2\mathbf u - \mathbf u_0, \qquad \mathbf v' = \mathbf H \mathbf u', \qquad
    \mathbf H = \mathbf V' \mathbf U'^T / N

with the factor N of U′U′ᵀ = N·I, which the thesis omits.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
import scipy
from jaxtyping import Float, Int8, Integer, Real, UInt8

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import check_fields, choice, whole

Order = Literal["sequency", "natural"]
Display = Literal["complementary", "binary"]
DARK_FRAMES = whole(0, 4096)


@checked
@dataclass(frozen=True)
class HadamardSeries:
    """Sequence of patterns for a calibration with a monitor.

    - `object_shape`: (rows, columns) of cells, N in all, a power of two.
    - `order`: "sequency", by the number of sign changes, or "natural" (Sylvester's).
    - `display`: "binary" shows the N patterns with 0 for −1; the first is all white. The offset of
      the frames, dark level and stray light, then appears in the first cell's column, so that dark
      frames are needed. "complementary" shows each pattern and then its complement: their
      difference has no offset, not even a slowly drifting one, and half the variance for twice the
      frames.
    - `dark_frames`: final frames with a black monitor; their mean is subtracted.

    **Errors**: ValueError for a number of cells that is not a power of two, and other names.
    """

    object_shape: tuple[int, int]
    order: Annotated[Order, choice(get_args(Order))] = "sequency"
    display: Annotated[Display, choice(get_args(Display))] = "complementary"
    dark_frames: Annotated[int, DARK_FRAMES] = 0

    def __post_init__(self):
        check_fields(self)
        object.__setattr__(self, "object_shape", checks.shape2d("object_shape", self.object_shape))
        _require_power_of_two(self.object_shape)

    @property
    def cell_count(self) -> int:
        """N, cells and patterns."""
        return math.prod(self.object_shape)

    @property
    def pattern_frames(self) -> int:
        """Frames that show patterns: N, or 2N with complements."""
        return self.cell_count * (2 if self.display == "complementary" else 1)

    @property
    def frame_count(self) -> int:
        """All frames, dark ones included."""
        return self.pattern_frames + self.dark_frames

    def frame(self, number: int) -> UInt8[np.ndarray, "y x"]:
        """Cells of frame `number`; 1 is white."""
        if not 0 <= number < self.frame_count:
            raise ValueError(
                f"frame {number} of {self.frame_count}: give 0 … {self.frame_count - 1}"
            )
        if number >= self.pattern_frames:
            return np.zeros(self.object_shape, np.uint8)
        step = self.pattern_frames // self.cell_count
        pattern = hadamard_pattern(number // step, self.object_shape, self.order)
        sign = -1 if number % step else 1
        return (sign * pattern > 0).astype(np.uint8)


@checked
def hadamard_pattern(
    index: int | np.integer, object_shape: tuple[int, int], order: Order = "sequency"
) -> Int8[np.ndarray, "y x"]:
    """Row `index` of the Hadamard matrix as ±1 on the cells of an object.

    The cells are numbered row by row. In natural order the sign is the parity of the bits that
    index and cell have in common.
    """
    count = _require_power_of_two(object_shape)
    if not 0 <= index < count:
        raise ValueError(f"index = {index}: there are {count} patterns; give 0 … {count - 1}")
    shared = np.bitwise_count(natural_rows(count, order)[index] & np.arange(count))
    return (1 - 2 * (shared & 1).astype(np.int8)).reshape(object_shape)


def natural_rows(count: int, order: Order) -> Integer[np.ndarray, " pattern"]:
    """Row of Sylvester's matrix for each pattern.

    The row with s sign changes is the bit reversal of the Gray code of s.
    """
    numbers = np.arange(count)
    if order == "natural":
        return numbers
    left, rows = numbers ^ (numbers >> 1), np.zeros_like(numbers)
    for _ in range(count.bit_length() - 1):
        rows, left = (rows << 1) | (left & 1), left >> 1
    return rows


def walsh_hadamard(
    values: Real[np.ndarray, "n pixel"], out: Float[np.ndarray, "pixel n"] | None = None
) -> Float[np.ndarray, "pixel n"]:
    """W·values transposed, with Sylvester's matrix W of n rows, without a factor: W·W = n·1.

    W is the Kronecker product of two small matrices, hence two products, H₆₄·X·H₆₄ for n = 4096,
    three times faster on a CPU than butterflies. The precision is that of `out`, where given, else
    that of the values, at least float32.
    """
    values = checks.numbers("values", values)
    if values.ndim != 2:
        raise ValueError(
            f"values has shape {values.shape}; give a row for each pattern, (n, pixel)"
        )
    count, pixels = values.shape
    _require_power_of_two((count, 1))
    if out is None:
        dtype = np.result_type(values, np.float32) if values.dtype.kind == "f" else np.float32
        out = np.empty((pixels, count), dtype)
    bits = count.bit_length() - 1
    halves = bits // 2, bits - bits // 2
    first, second = (scipy.linalg.hadamard(2**k, out.dtype) for k in halves)
    a, b = len(first), len(second)
    for start in range(0, pixels, _AT_ONCE):
        part = values[:, start : start + _AT_ONCE].astype(out.dtype)
        half = (first @ part.reshape(a, -1)).reshape(a, b, -1)
        for row in range(a):
            # A transposed factor costs no time here.
            into = out[start : start + _AT_ONCE, row * b : (row + 1) * b]
            np.matmul(half[row].T, second, out=into)
    return out


_AT_ONCE = 256  # pixels whose 4096 numbers fit a CPU's cache: half the time of 8000


def _require_power_of_two(object_shape: tuple[int, int]) -> int:
    count = math.prod(object_shape)
    if count < 1 or count & (count - 1):
        near = 2 ** round(math.log2(max(count, 1)))
        raise ValueError(
            f"{object_shape[0]} × {object_shape[1]} = {count} cells are no power of two, as "
            f"Hadamard patterns need; give sizes that multiply to one, such as {near}"
        )
    return count
