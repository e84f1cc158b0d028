"""Demosaicing: red, green and blue from the mosaic of a colour sensor."""

from typing import Literal, cast, get_args

import numpy as np
import scipy
from jaxtyping import Bool, Float, Shaped

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax.imaging.encoding import upright

Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
Demosaicing = Literal["bilinear", "superpixel"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
METHODS = get_args(Demosaicing)

# Weights of the samples around a pixel: for a colour at one site in four, or two in four as green,
# these interpolate linearly between the nearest samples.
_SPARSE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=np.float32)
_GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype=np.float32)
_KERNELS = {"R": _SPARSE, "G": _GREEN, "B": _SPARSE}


@checked
def demosaic(
    mosaic: Shaped[np.ndarray, "y x"],
    pattern: Pattern,
    method: Demosaicing = "bilinear",
    known: Bool[np.ndarray, "y x"] | None = None,
) -> Float[np.ndarray, "rows columns 3"]:
    r"""Red, green and blue of a raw image whose pixels each measure one of them.

    `pattern` names the colours of the upper left 2×2 pixels, row by row. With m_c = 1 where a pixel
    measures colour c (and is `known`), a 3×3 kernel k_c and the mosaic I,

    .. math:: I_c = \frac{k_c * (m_c I)}{k_c * m_c}

    (normalised convolution, Knutsson and Westin 1993), which is

    - "bilinear": linear interpolation between the nearest samples, exact for a linear ramp except
      in the outermost pixels, which take the mean of the nearest samples. It blurs, so the noise of
      neighbouring pixels is correlated.
    - "superpixel": the mean of each colour in each 2×2 block; half the size, no interpolation,
      independent noise. Red and blue are then sampled half a (new) pixel apart, in the PSF as in
      the capture, so that channels reconstructed one by one are in register. Best where the image
      is downsampled anyway. Needs even sizes.

    A value without any known sample is 0: see `demosaic_mask`. float32 (float64 stays).

    **Errors**: ValueError for an unknown pattern or method and for odd sizes of "superpixel".
    """
    values = mosaic if mosaic.dtype == np.float64 else mosaic.astype(np.float32)
    return demosaiced(values, pattern, method, known, 1)


def demosaiced(
    values: np.ndarray, pattern: Pattern, method: Demosaicing, known: np.ndarray | None, power: int
) -> np.ndarray:
    """`demosaic`, or with a power of 2 of the weights the variance of its noise."""
    sites, channels = colour_sites(values.shape, pattern), []
    for colour in "RGB":
        used = sites[colour] if known is None else sites[colour] & known
        weight = _gather(used.astype(values.dtype), colour, method) ** power
        total = _gather(np.where(used, values, 0), colour, method, power)
        channels.append(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0))
    return np.stack(channels, axis=-1)


def mosaic(
    colours: Shaped[np.ndarray, "*batch 3 y x"], pattern: Pattern
) -> Shaped[np.ndarray, "*batch y x"]:
    """Mosaic of red, green and blue light that a sensor with a pattern measures."""
    sites = np.stack(list(colour_sites(colours.shape[-2:], pattern).values()))
    return np.where(sites, colours, 0).sum(axis=-3)


def turned_pattern(pattern: Pattern, shape: tuple[int, ...], orientation: int) -> Pattern:
    """Pattern of a mosaic of a shape that was turned upright by its orientation."""
    sites = colour_sites(shape, pattern)
    letters = np.select(list(sites.values()), list(sites), "")
    return cast(Pattern, "".join(upright(letters, orientation)[:2, :2].ravel()))


def shifted_pattern(pattern: Pattern, top: int, left: int) -> Pattern:
    """Pattern of the part of a mosaic that begins at a row and a column."""
    rows, columns = (top % 2, 1 - top % 2), (left % 2, 1 - left % 2)
    return cast(Pattern, "".join(pattern[2 * y + x] for y in rows for x in columns))


@checked
def demosaic_mask(
    mask: Bool[np.ndarray, "y x"], pattern: Pattern, method: Demosaicing = "bilinear"
) -> Bool[np.ndarray, "rows columns 3"]:
    """Values of `demosaic` that depend on a pixel of the mask."""
    sites = colour_sites(mask.shape, pattern)
    return np.stack(
        [_gather((mask & sites[c]).astype(np.float32), c, method) > 0 for c in "RGB"], axis=-1
    )


def colour_sites(shape: tuple[int, ...], pattern: Pattern) -> dict[str, np.ndarray]:
    """Sites of each of the colours R, G and B in the mosaic: three maps (y, x)."""
    checks.choice("pattern", pattern, PATTERNS)
    tile = np.array(list(pattern)).reshape(2, 2)
    rows, columns = shape
    mosaic = np.tile(tile, ((rows + 1) // 2, (columns + 1) // 2))[:rows, :columns]
    return {colour: mosaic == colour for colour in "RGB"}


def _gather(values: np.ndarray, colour: str, method: Demosaicing, power: int = 1) -> np.ndarray:
    """Sums of the samples that each value depends on, by a power of their weights."""
    checks.choice("method", method, METHODS)
    rows, columns = values.shape
    if method == "bilinear":
        if min(rows, columns) < 2:
            raise ValueError(f"the mosaic has {rows}×{columns} pixels; give at least 2×2")
        return scipy.ndimage.convolve(values, _KERNELS[colour] ** power, mode="constant")
    if rows % 2 or columns % 2:
        raise ValueError(
            f"'superpixel' joins 2×2 pixels and the mosaic has {rows}×{columns}: cut off the last "
            "row or column, or choose 'bilinear'"
        )
    pairs = values[::2] + values[1::2]
    return pairs[:, ::2] + pairs[:, 1::2]
