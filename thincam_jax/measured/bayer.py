"""From the mosaic of a colour sensor to red, green and blue."""

from typing import Literal

import numpy as np
import scipy
from jaxtyping import Bool, Float, Shaped

from thincam_jax._core import checks

Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
Demosaicing = Literal["bilinear", "superpixel"]
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
METHODS = ("bilinear", "superpixel")

# Weights of the samples around a pixel: with a colour at one site in four, or at two in four as
# green, these interpolate linearly between its nearest samples.
_SPARSE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=np.float32)
_GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype=np.float32)
_KERNELS = {"R": _SPARSE, "G": _GREEN, "B": _SPARSE}


def demosaic(
    mosaic: Shaped[np.ndarray, "y x"],
    pattern: Pattern,
    method: Demosaicing = "bilinear",
    known: Bool[np.ndarray, "y x"] | None = None,
) -> Float[np.ndarray, "rows columns 3"]:
    r"""Red, green and blue of a raw image whose pixels each see one of them.

    `pattern` names the colours of the upper left 2×2 pixels, row by row. With m_c = 1 where a pixel
    sees colour c (and is `known`), a 3×3 kernel k_c and the mosaic I,

    .. math:: I_c = \frac{k_c * (m_c I)}{k_c * m_c}

    (normalised convolution, Knutsson and Westin 1993), which is

    - "bilinear": linear interpolation between the nearest samples, exact for a brightness that
      changes linearly, but for the outermost pixels, where it repeats the nearest samples' mean.
      It blurs, so neighbouring pixels share their noise.
    - "superpixel": the mean of each colour in each 2×2 block; half the size, nothing interpolated,
      noise stays independent. Red and blue are then sampled half a (new) pixel apart: a PSF and a
      capture of the same mosaic are so alike, and what is reconstructed channel by channel is in
      register. To be preferred where the image is downsampled anyway. Needs even sizes.

    A value without any known sample is 0: see `demosaic_mask` for where. float32 (float64 stays).

    **Errors**: ValueError for an unknown pattern or method and for odd sizes of "superpixel".
    """
    sites = colour_sites(mosaic.shape, pattern)
    values = mosaic if mosaic.dtype == np.float64 else mosaic.astype(np.float32)
    channels = []
    for colour in "RGB":
        used = sites[colour] if known is None else sites[colour] & known
        weight = _gather(used.astype(values.dtype), colour, method)
        total = _gather(np.where(used, values, 0), colour, method)
        channels.append(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0))
    return np.stack(channels, axis=-1)


def demosaic_mask(
    mask: Bool[np.ndarray, "y x"], pattern: Pattern, method: Demosaicing = "bilinear"
) -> Bool[np.ndarray, "rows columns 3"]:
    """Which of the values of `demosaic` draw on a pixel of the mask."""
    sites = colour_sites(mask.shape, pattern)
    return np.stack(
        [_gather((mask & sites[c]).astype(np.float32), c, method) > 0 for c in "RGB"], axis=-1
    )


def colour_sites(shape: tuple[int, ...], pattern: Pattern) -> dict[str, np.ndarray]:
    """Where in the mosaic each of the colours R, G and B is seen: three maps (y, x)."""
    checks.choice("pattern", pattern, PATTERNS)
    tile = np.array(list(pattern)).reshape(2, 2)
    rows, columns = shape
    mosaic = np.tile(tile, ((rows + 1) // 2, (columns + 1) // 2))[:rows, :columns]
    return {colour: mosaic == colour for colour in "RGB"}


def _gather(values: np.ndarray, colour: str, method: Demosaicing) -> np.ndarray:
    """The weighted sum of the samples that a value is made of."""
    checks.choice("method", method, METHODS)
    rows, columns = values.shape
    if method == "bilinear":
        if min(rows, columns) < 2:
            raise ValueError(f"the mosaic has {rows}×{columns} pixels; give at least 2×2")
        return scipy.ndimage.convolve(values, _KERNELS[colour], mode="constant")
    if rows % 2 or columns % 2:
        raise ValueError(
            f"'superpixel' joins 2×2 pixels and the mosaic has {rows}×{columns}: cut off the last "
            "row or column, or choose 'bilinear'"
        )
    pairs = values[::2] + values[1::2]
    return pairs[:, ::2] + pairs[:, 1::2]
