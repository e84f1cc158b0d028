"""Checks of measured images."""

import numpy as np


def measured(name: str, image, shape: tuple[int, int] | None, of: str) -> np.ndarray:
    """A finite image with contrast, in double precision, or one line that says what is wrong.

    `shape`: the one it must have, that of `of`; None for any (y, x).
    """
    image = np.asarray(image)
    if image.dtype.kind not in "fiu" or image.ndim != 2 or shape not in (None, image.shape):
        wanted = "an image (y, x)" if shape is None else f"the {shape} pixels of {of}"
        raise ValueError(
            f"{name} has shape {image.shape} and type {image.dtype}; give real numbers on {wanted}"
        )
    image = image.astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(image)))
    if bad:
        raise ValueError(f"{name} has {bad} pixels that are not finite; replace them first")
    if image.size == 0 or np.ptp(image) <= 1e-12 * np.abs(image).max():
        level = f"{image.flat[0]:g} in every pixel" if image.size else "empty"
        raise ValueError(f"{name} is {level}: give one that shows something")
    return image
