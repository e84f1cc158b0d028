"""One small mask of every family of few terms, and the field behind it by quadrature.

Nothing of the package's optics is used: the transmittance of every cell is worked out from the
family's definition, and Fresnel's integral is a sum over Gauss-Legendre nodes in every cell.
"""

import jax
import numpy as np

import thincam_jax as tc
from thincam_jax.lensless.masks import (
    UniformlyRedundantArray,
    maximum_length_sequence,
    random_cells,
)

CELL, CENTRE = 0.03, (0.02, -0.05)
WAVELENGTH, DISTANCE = 550e-6, 2.0
SHAPE, PITCH = (14, 19), 0.031
_NODES = 60, 200  # in a cell, and in a lens


def masks(cell=CELL, centre=CENTRE):
    """By name."""
    codes = maximum_length_sequence(7), maximum_length_sequence(15)
    random = random_cells(jax.random.key(1), 8 * cell, cell, height=5 * cell)
    return {
        "mura": tc.ModifiedUniformlyRedundantArray(5, cell, tiles=(1, 2), centre=centre),
        "ura": UniformlyRedundantArray((7, 5), cell, centre=centre),
        "product": tc.SeparableMask(*codes, cell, centre=centre),
        "xor": tc.SeparableMask(*codes, cell, combine="xor", centre=centre),
        "random": tc.SampledMask(random.amplitude, cell, centre=centre),
        "pinhole": tc.Pinhole(8 * cell, 5 * cell, centre=centre),
        "lenslets": tc.LensletArray(3.0, 5 * cell, (2, 3), centre=centre),
    }


def residue(i, p):
    """1 for the squares modulo p but zero, else −1; 0 for zero."""
    return 0 if i % p == 0 else (1 if any(n * n % p == i % p for n in range(1, p)) else -1)


def redundant(rows, columns):
    """Cell by cell, as the arrays are defined."""
    return np.array(
        [
            [
                0.0 if i == 0 else 1.0 if j == 0 else residue(i, rows) * residue(j, columns) == 1
                for j in range(columns)
            ]
            for i in range(rows)
        ],
        float,
    )


def cells(name, mask):
    """Transmittance of every cell."""
    codes = maximum_length_sequence(7)[:, None], maximum_length_sequence(15)
    known = {
        "mura": lambda: np.tile(redundant(5, 5), (1, 2)),
        "ura": lambda: redundant(7, 5),
        "product": lambda: codes[0] * codes[1],
        "xor": lambda: (codes[0] != codes[1]).astype(float),
        "random": lambda: np.asarray(mask.amplitude),
        "pinhole": lambda: np.ones((5, 8)),
        "lenslets": lambda: np.ones((2, 3)),
    }
    return known[name]()


def psf(name, mask, object_distance, *, wavelength=WAVELENGTH, distance=DISTANCE, points=None):
    """|U|² relative to the open aperture, at pixel centres or other `points` (y, x)."""
    values = cells(name, mask)
    cell = 5 * CELL if name == "lenslets" else CELL
    focal_length = 3.0 if name == "lenslets" else np.inf
    nodes, weights = np.polynomial.legendre.leggauss(_NODES[name == "lenslets"])
    places = points or [(np.arange(n) - (n - 1) / 2) * PITCH for n in SHAPE]

    def along(count, middle, x):
        centres = (np.arange(count) - (count - 1) / 2) * cell
        own = nodes * cell / 2
        xi = middle + centres[:, None] + own
        turns = (x[:, None, None] - xi) ** 2 / (2 * wavelength * distance)
        turns = turns + xi**2 / (2 * wavelength * object_distance)
        turns = turns - own**2 / (2 * wavelength * focal_length)
        return np.exp(2j * np.pi * turns) @ weights * cell / 2

    rows = along(values.shape[0], CENTRE[0], places[0])
    columns = along(values.shape[1], CENTRE[1], places[1])
    field = rows @ values @ columns.T / (wavelength * distance)
    return np.abs(field) ** 2 * (1 + distance / object_distance) ** 2
