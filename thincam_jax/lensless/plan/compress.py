"""Few columns that stand for many: an interpolative decomposition under a weight."""

import numpy as np
import scipy
from jaxtyping import Complex, Float


def order_of_columns(columns: Complex[np.ndarray, "k n"]) -> list[int]:
    """Columns in the order in which they add most to those before (QR with pivoting)."""
    stacked = np.concatenate([np.real(columns), np.imag(columns)])
    decomposition = scipy.linalg.qr(stacked, mode="r", pivoting=True)
    return [int(p) for p in decomposition[-1]]


def fit(
    columns: Complex[np.ndarray, "k few"], target: Complex[np.ndarray, " k"]
) -> Float[np.ndarray, " few"]:
    """Real weights of the columns that come closest to the target."""
    stacked = np.concatenate([np.real(columns), np.imag(columns)])
    wanted = np.concatenate([np.real(target), np.imag(target)])
    return np.linalg.lstsq(stacked, wanted, rcond=1e-12)[0]
