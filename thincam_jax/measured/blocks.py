"""Downsampling by block means, and masks that go with it."""

import numpy as np
from jaxtyping import Bool, Float

from thincam_jax.measured.raw import MeasurementError


def crop_to_blocks(shape: tuple[int, int], factor: int) -> tuple[slice, slice]:
    """The central part of a (y, x) image whose sides are multiples of the factor."""
    if factor > min(shape):
        raise MeasurementError(
            f"downsample = {factor} is larger than the image of {shape[0]}×{shape[1]} pixels"
        )
    slices = []
    for count in shape:
        kept = count - count % factor
        start = (count - kept) // 2
        slices.append(slice(start, start + kept))
    return slices[0], slices[1]


def block_mean(
    image: Float[np.ndarray, "channel y x"],
    factor: int,
    known: Bool[np.ndarray, "channel y x"] | None = None,
) -> Float[np.ndarray, "channel rows columns"]:
    """The mean of each block of factor × factor pixels, over the known ones; 0 if there is none.

    A mean of pixels is what a pixel of that size would have measured, so it keeps the light's sum
    (in the mean) and lowers independent noise by the factor. Sides must be multiples of the factor.
    """
    if known is None:
        return (_block_sum(image, factor) / factor**2).astype(image.dtype)
    total, count = _block_sum(np.where(known, image, 0), factor), _block_sum(known, factor)
    return np.divide(total, count, out=np.zeros_like(total), where=count > 0).astype(image.dtype)


def block_any(
    mask: Bool[np.ndarray, "channel y x"], factor: int
) -> Bool[np.ndarray, "channel rows columns"]:
    """Which blocks hold a marked pixel."""
    return _block_sum(mask, factor) > 0


def _block_sum(image: np.ndarray, factor: int) -> np.ndarray:
    """In float64; rows first, which leaves little for the slower sum along them."""
    channels, rows, columns = image.shape
    tall = image.reshape(channels, rows // factor, factor, columns).sum(axis=2, dtype=np.float64)
    return tall.reshape(channels, rows // factor, columns // factor, factor).sum(axis=3)
