r"""Norms of separable sums from their one-dimensional factors.

With real factors R (term × row) and C (term × column) the image is RᵀC and
:math:`\|R^TC\|_F^2 = \sum (RR^T)\circ(CC^T)`: the error of a whole PSF costs what its axes cost.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from thincam_jax.lensless.propagation.separable_sum import SeparableSum


class Factors(NamedTuple):
    """Real factors of an image on chosen rows and columns, each scaled by the root of its weight.

    - `rows`, `columns`: factor × sample, in double precision.
    """

    rows: Float[np.ndarray, "factor row"]
    columns: Float[np.ndarray, "factor column"]


def factors(
    terms: SeparableSum,
    row_weights: Float[np.ndarray, " row"],
    column_weights: Float[np.ndarray, " column"],
) -> Factors:
    """The factors of a separable sum whose samples stand for `weights` samples each."""
    return weighted(
        np.asarray(terms.rows, complex),
        np.asarray(terms.columns, complex),
        row_weights,
        column_weights,
    )


def weighted(
    rows: Complex[np.ndarray, "term row"],
    columns: Complex[np.ndarray, "term column"],
    row_weights: Float[np.ndarray, " row"],
    column_weights: Float[np.ndarray, " column"],
) -> Factors:
    """The same from the complex factors of Σ Re{Y X}."""
    rows, columns = rows * np.sqrt(row_weights), columns * np.sqrt(column_weights)
    # Re{YX} = Re Y Re X − Im Y Im X.
    return Factors(
        np.concatenate([np.real(rows), -np.imag(rows)]),
        np.concatenate([np.real(columns), np.imag(columns)]),
    )


def norm(image: Factors) -> float:
    """‖h‖₂ over the grid."""
    square = np.sum((image.rows @ image.rows.T) * (image.columns @ image.columns.T))
    return float(np.sqrt(max(square, 0.0)))


def distance(first: Factors, second: Factors) -> float:
    """‖h₁ − h₂‖₂ for sums of different terms; what cancels leaves 1e-8 of their norms."""
    return norm(
        Factors(
            np.concatenate([first.rows, second.rows]),
            np.concatenate([first.columns, -second.columns]),
        )
    )


def rounding_distance(first: Factors, second: Factors) -> float:
    """‖h₁ − h₂‖₂ for sums of the same terms, nearly equal: no digits cancel."""
    return norm(
        Factors(
            np.concatenate([first.rows - second.rows, second.rows]),
            np.concatenate([first.columns, first.columns - second.columns]),
        )
    )
