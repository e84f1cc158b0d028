"""What a least-squares fit knows: standard errors, correlations, and what it cannot tell apart."""

from typing import NamedTuple

import numpy as np

# Two numbers of correlation ρ have standard errors 1/√(1−ρ²) times those they would have if the
# other were known: at 0.999, 22 times. The image then holds one combination of the two by more than
# a digit better than either, and any small flaw of the model goes into the difference.
AMBIGUOUS = 0.999
# The smallest eigenvalue, relative to the unit diagonal, that is not rounding.
_SMALLEST = 1e-13


class Covariance(NamedTuple):
    """Of the unknowns of a fit, in their order."""

    standard_errors: np.ndarray
    correlation: np.ndarray


def covariance(curvature: np.ndarray, variance: float) -> Covariance:
    """σ²(JᵀJ)⁻¹ as standard errors and correlations.

    `curvature`: JᵀJ. `variance`: σ² of a residual, taken as white. A direction that the data do not
    see at all has, in place of an infinite error, that of an eigenvalue at the rounding's level:
    about 1e6 times the error of a number that is seen.
    """
    norm = np.sqrt(np.diag(curvature))
    norm = np.where(norm > 0, norm, norm.max() * _SMALLEST or 1.0)
    values, vectors = np.linalg.eigh(curvature / np.outer(norm, norm))
    inverse = (vectors / np.maximum(values, _SMALLEST)) @ vectors.T
    spread = np.sqrt(np.diag(inverse))
    correlation = inverse / np.outer(spread, spread)
    return Covariance(np.sqrt(variance) * spread / norm, np.clip(correlation, -1.0, 1.0))


def of_values(steps: Covariance, slopes: np.ndarray) -> Covariance:
    """The covariance of values from that of steps, with ∂values/∂steps."""
    scaled = slopes * steps.standard_errors
    whole = scaled @ steps.correlation @ scaled.T
    errors = np.sqrt(np.diag(whole))
    safe = np.where(errors > 0, errors, 1.0)
    return Covariance(errors, np.clip(whole / np.outer(safe, safe), -1.0, 1.0))


def ambiguous_pairs(names: tuple[str, ...], correlation: np.ndarray) -> list[str]:
    """One line for each pair of unknowns that the data cannot tell apart, most alike first."""
    rows, columns = np.triu_indices(len(names), 1)
    found = [
        (
            abs(rho),
            f"{names[i]} and {names[j]} cannot be told apart: their correlation is {rho:.6f}",
        )
        for i, j, rho in zip(rows, columns, correlation[rows, columns], strict=True)
        if abs(rho) > AMBIGUOUS
    ]
    return [text + "; fix one of them" for _, text in sorted(found, reverse=True)]
