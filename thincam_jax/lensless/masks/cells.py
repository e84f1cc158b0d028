"""Masks of square cells: few products of patterns, and uniformly redundant arrays."""

import abc
from collections.abc import Callable
from typing import Any, Literal, get_args

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


_LARGEST = 4096


class AbstractRedundantArray(AbstractCellMask):
    r"""An array of r × s cells from quadratic residues, or several of them side by side.

    With the Legendre symbol :math:`C_i = +1` for the squares :math:`i = n^2 \bmod p \neq 0`, −1 for
    the rest and :math:`C_0 = 0`: a cell (i, j) is closed for i = 0, open for j = 0 ≠ i, else open
    where :math:`C_i C_j = 1`. That is of rank 2,

    .. math:: A = \tfrac12 (u w^T + c\, d^T), \quad u = (0, 1, \dots, 1),\ w = u + 2e_0

    with the symbols c modulo r and d modulo s.
    """

    tiles: eqx.AbstractVar[tuple[int, int]]

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int]:
        """Cells (r, s) of one array."""

    def patterns(self) -> Patterns:
        symbols = [_legendre_symbols(p) for p in self.shape]
        u, w = (np.where(s == 0, zero, 1.0) for s, zero in zip(symbols, (0, 2), strict=True))
        rows, columns = (
            np.tile(np.stack(both), tiles)
            for both, tiles in zip(((u, symbols[0]), (w, symbols[1])), self.tiles, strict=True)
        )
        return Patterns(np.full(2, 0.5), rows, columns)

    @property
    def decoder(self) -> Float[Array, "row column"]:
        """G = 2A − 1 of one array: its periodic correlation with A is flat but for one point."""
        rows, columns = self.shape
        return 2 * self.cells[:rows, :columns] - 1


def _is_prime(p: int) -> bool:
    return p > 1 and all(p % n for n in range(2, int(p**0.5) + 1))


def _prime_order(name: str, order: Any) -> int:
    def fits(p):
        return p >= 5 and _is_prime(p)

    number = checks.whole(name, order, 1)
    if fits(number) and number <= _LARGEST:
        return number
    raise ValueError(
        f"{name} = {number} is no prime from 5 to {_LARGEST}; give {_near(number, fits)}"
    )


def _twin_primes(name: str, orders: Any) -> tuple[int, int]:
    def fits(s):
        return _is_prime(s) and _is_prime(s + 2)

    r, s = checks.shape2d(name, orders)
    if r == s + 2 and s <= _LARGEST and fits(s):
        return r, s
    near = _near(min(r, s), fits, lambda s: f"({s + 2}, {s})")
    raise ValueError(f"{name} = {checks.shown(orders)} are no twin primes (s + 2, s); give {near}")


def _near(number: Any, fits: Callable[[int], bool], text: Callable[[int], str] = str) -> str:
    """The nearest that fit below and above, in words."""
    at = min(max(int(number), 0), _LARGEST)
    below = next((n for n in range(at, 0, -1) if fits(n)), None)
    above = next((n for n in range(at + 1, _LARGEST + 1) if fits(n)), None)
    return " or ".join(text(n) for n in (below, above) if n is not None)


def _tiles(tiles: Any) -> tuple[int, int]:
    down, across = (tiles, tiles) if isinstance(tiles, int) else tiles
    checks.at_least_one({"tiles": min(down, across)})
    return int(down), int(across)


class ModifiedUniformlyRedundantArray(AbstractRedundantArray):
    r"""A MURA of p × p cells (Gottesman and Fenimore 1989), half of them open.

    With :math:`G = 2A - 1` but :math:`G_{00} = +1` (`decoder`) the periodic correlation is a single
    point, :math:`A \star G = \tfrac{p^2-1}{2}\,\delta`, and :math:`|\hat A|` is
    :math:`(p \pm 1)/2` at every frequency but zero.

    **Arguments**

    - `order`: p, a prime of at least 5.
    - `cell`: side of a cell, mm.
    - `tiles`: how often the array is repeated, one number or (down, across). A mask that is to
      throw one whole array from every direction has two.
    - `centre`: (y, x) of the mask's centre, mm.

    **Errors**: ValueError for a number that is no such prime, with the nearest two.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.ModifiedUniformlyRedundantArray(13, cell=60 * um)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=2.0)
    h = tc.psf(camera, wavelength=500 * nm)
    ```

    **See also**: `lensless.masks.UniformlyRedundantArray`.
    """

    order: int = eqx.field(converter=quantity(check=_prime_order), static=True)
    tiles: tuple[int, int] = eqx.field(default=1, converter=_tiles, static=True, kw_only=True)
    cell: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )

    @property
    def shape(self) -> tuple[int, int]:
        return self.order, self.order

    @property
    def decoder(self) -> Float[Array, "row column"]:
        """G = 2A − 1 with G₀₀ = +1: A ⋆ G is a point."""
        return super().decoder.at[0, 0].set(1.0)


class UniformlyRedundantArray(AbstractRedundantArray):
    r"""A URA of r × s cells for twin primes r = s + 2 (Fenimore and Cannon 1978).

    Its periodic autocorrelation has the peak (rs + 1)/2 and is (rs + 1)/4 everywhere else.

    **Arguments**: as of `ModifiedUniformlyRedundantArray`, with `orders` = (r, s).

    **Errors**: ValueError for orders that are no twin primes, with the nearest that are.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.lensless.masks.UniformlyRedundantArray((13, 11), cell=60 * um)
    ```

    **See also**: `ModifiedUniformlyRedundantArray`.
    """

    orders: tuple[int, int] = eqx.field(converter=quantity(check=_twin_primes), static=True)
    tiles: tuple[int, int] = eqx.field(default=1, converter=_tiles, static=True, kw_only=True)
    cell: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )

    @property
    def shape(self) -> tuple[int, int]:
        return self.orders


def _legendre_symbols(p: int) -> Float[np.ndarray, " p"]:
    """C_i for i = 0 … p − 1."""
    symbols = np.full(p, -1.0)
    symbols[np.arange(1, p) ** 2 % p] = 1.0
    symbols[0] = 0.0
    return symbols
