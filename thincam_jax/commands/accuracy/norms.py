"""Relative errors of images."""

import numpy as np


def relative_error(image, reference) -> float:
    """‖image − reference‖₂ / ‖reference‖₂ over all numbers, real or complex."""
    image, reference = np.asarray(image, complex), np.asarray(reference, complex)
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def contrast_error(image, reference) -> float:
    """The same without the mean of each (y, x) image: the bias of a capture carries no picture."""
    contrasts = (np.asarray(a, float) for a in (image, reference))
    return relative_error(*(c - c.mean(axis=(-2, -1), keepdims=True) for c in contrasts))
