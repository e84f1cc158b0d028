"""Figures of merit of reconstructions."""

import math


def rounded(score: float, digits: int = 3) -> float | None:
    """A PSNR, dB, for metrics; None where nothing differs, which JSON has no number for."""
    return round(score, digits) if math.isfinite(score) else None
