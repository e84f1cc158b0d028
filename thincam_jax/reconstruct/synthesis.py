r"""Which captures are added and subtracted before the deconvolution.

A synthesis is a real matrix W (channel × capture): the channel c is Σ_k W_ck g_k, and its response
Σ_k W_ck H_k. The fringe-scanned response of the thesis is complex; its real and imaginary parts are
two real channels here, so that results are real without a projection and noise is counted right.
"""

import numpy as np


def separate(count: int) -> np.ndarray:
    """Every capture a channel of its own: one capture, or colour channels."""
    return np.eye(count)


def fringe_scanning(groups: int) -> np.ndarray:
    """Captures in groups of four phases 0, π/2, π, 3π/2 (thesis Eq 3.14, 3.31, corrected).

    For each group the channels H(3π/2) − H(π/2) and H(0) − H(π), which are (π/β)cos X and
    (π/β)sin X times the diffraction term, X = π²ρ²/β: constant and second harmonic cancel.
    """
    return np.kron(np.eye(groups), np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, -1.0, 0.0]]))


def phase_pairs(groups: int) -> np.ndarray:
    """Captures in pairs of phases 0, 3π/2: H(0) − H(3π/2) of each (thesis Eq 3.49, corrected).

    The constant cancels; the second harmonic, and with it twice the aperture's cut-off, stays.
    """
    return np.kron(np.eye(groups), np.array([[1.0, -1.0]]))
