"""Masks of square cells that are a sum of few products of a pattern down and one across."""

import abc
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.precision import as_complex
from thincam_jax._core.quantity import choice, quantity
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AxisFactors, MaskTerms

Combination = Literal["product", "xor"]
COMBINATIONS: tuple[Combination, ...] = get_args(Combination)
_LONGEST_REGISTER = 16


class Patterns(eqx.Module):
    """The cells of a mask, Σ_k coefficients[k] · rows[k, i] · columns[k, j]."""

    coefficients: Float[np.ndarray | Array, " term"]
    rows: Float[np.ndarray | Array, "term row"]
    columns: Float[np.ndarray | Array, "term column"]


class AbstractCellMask(AbstractFactoredMask):
    """A mask of open, closed or grey square cells, of low rank.

    - `cell`: side of a cell, mm.
    """

    cell: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def patterns(self) -> Patterns:
        """The cells' amplitude transmittances as products."""

    @property
    def cells(self) -> Float[Array, "row column"]:
        """Amplitude transmittance of every cell."""
        parts = self.patterns()
        rows = parts.coefficients[:, None] * parts.rows
        return jnp.asarray(rows.T @ parts.columns, self.cell.dtype)

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        parts = self.patterns()
        return parts.rows.shape[1] * self.cell, parts.columns.shape[1] * self.cell

    @property
    def finest_frequency(self) -> Float[Array, ""]:
        """Frequency of alternating cells, cycles/mm."""
        return 0.5 / self.cell

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        parts = self.patterns()
        coefficients, *both = (
            as_complex(jnp.asarray(part, self.cell.dtype))
            for part in (parts.coefficients, parts.rows, parts.columns)
        )
        rows, columns = (AxisFactors(cell_edges(v.shape[1], self.cell), v) for v in both)
        return MaskTerms(coefficients, rows, columns)


def cell_edges(count: int, cell: Float[Array, ""]) -> Float[Array, " edge"]:
    """Edges of so many cells about the mask's centre, mm."""
    return (jnp.arange(count + 1, dtype=cell.dtype) - count / 2) * cell


class SeparableMask(AbstractCellMask):
    r"""Two one-dimensional codes a (down) and b (across), as in FlatCam.

    - "product": t_ij = a_i b_j, of rank 1.
    - "xor": t_ij = a_i (1 − b_j) + (1 − a_i) b_j, open where one of two binary codes is: of rank 2,
      and of half the light where a product of them has a quarter.

    **Arguments**

    - `rows`, `columns`: the codes, amplitudes of 0 to 1; of `maximum_length_sequence`, for one.
    - `cell`: side of a cell, mm.
    - `combine`: "product" or "xor".
    - `centre`: (y, x) of the mask's centre, mm.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    code = tc.lensless.masks.maximum_length_sequence(31)
    mask = tc.SeparableMask(code, code, cell=30 * um, combine="xor")
    ```

    **See also**: `lensless.masks.maximum_length_sequence`, `separable_operator`.
    """

    rows: Float[Array, " row"] = eqx.field(converter=quantity(check=checks.transmittances))
    columns: Float[Array, " column"] = eqx.field(converter=quantity(check=checks.transmittances))
    cell: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )
    combine: Combination = eqx.field(
        default="product", converter=choice(COMBINATIONS), static=True, kw_only=True
    )

    def patterns(self) -> Patterns:
        a, b = self.rows, self.columns
        if self.combine == "product":
            return Patterns(np.ones(1), a[None], b[None])
        return Patterns(np.ones(2), jnp.stack([a, 1 - a]), jnp.stack([1 - b, b]))


@checked
def maximum_length_sequence(length: int) -> Float[np.ndarray, " length"]:
    """A binary code of 0 and 1 and of length N = 2^m − 1, half of it open.

    The periodic autocorrelation of 2s − 1 is N at zero and −1 elsewhere: its spectrum is flat.

    **Errors**: ValueError for another length, with those next to it.

    ```python
    import thincam_jax as tc

    print(tc.lensless.masks.maximum_length_sequence(7))  # [1. 1. 1. 0. 1. 0. 0.]
    ```

    **See also**: `SeparableMask`.
    """
    register = int(length + 1).bit_length() - 1
    if length != 2**register - 1 or not 2 <= register <= _LONGEST_REGISTER:
        low = min(max(register, 2), _LONGEST_REGISTER - 1)
        raise ValueError(
            f"length = {length} is not 2^m − 1 with m from 2 to {_LONGEST_REGISTER}; "
            f"give {2**low - 1} or {2 ** (low + 1) - 1}"
        )
    return scipy.signal.max_len_seq(register)[0].astype(float)
