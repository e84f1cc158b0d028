"""Raw files of cameras, as tests write them."""

import io

import numpy as np
import tifffile

from thincam_jax.imaging.encoding import ORIENTATION, upright
from thincam_jax.measured.bayer import colour_sites, mosaic

SHAPE, BLACK, WHITE = (36, 52), 256, 4095
RNG = np.random.default_rng(0)
COLOURS = RNG.uniform(100, 3000, (3, *SHAPE)) * np.array([1.0, 0.7, 0.3])[:, None, None]
# Linear sRGB of XYZ, white D65 (IEC 61966-2-1).
SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def dng(
    pattern, orientation=1, black=BLACK, light=COLOURS, white=WHITE, more=(), sites=(), matrix=None
):
    """A DNG 1.4 whose pixels lie as its orientation says; several levels `black` are in `light`."""
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    level = black if isinstance(black, int) else 0
    pixels = upright(np.rint(mosaic(np.asarray(light), pattern)).astype(np.uint16) + level, inverse)
    letters = np.select(list(colour_sites(np.shape(light)[-2:], pattern).values()), list("RGB"), "")
    bayer = ["RGB".index(letter) for letter in upright(letters, inverse)[:2, :2].ravel()]
    sites, side = sites or bayer, 6 if sites else 2
    matrix = np.eye(3) if matrix is None else np.asarray(matrix)  # XYZ to the camera's colours
    parts = [part for value in matrix.ravel() for part in (round(10_000 * value), 10_000)]
    tags = [
        (50706, 1, 4, (1, 4, 0, 0), True),
        (50708, 2, 0, "Test camera", True),
        (33421, 3, 2, (side, side), True),
        (33422, 1, side**2, tuple(sites), True),
        (50721, 10, 9, parts, True),
        (50714, 4, np.size(black), black, True),
        (50717, 4, 1, white, True),
        (50728, 5, 3, (1,) * 6, True),
        (50778, 3, 1, 21, True),
        (ORIENTATION, 3, 1, orientation, True),
        *more,
    ]
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.ascontiguousarray(pixels), photometric=32803, extratags=tags)
    return stream.getvalue()
