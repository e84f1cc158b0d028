"""Cameras to learn reconstruction behind: the shadows of drawn masks, on the pixels of a sensor."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

_FINER = 3  # samples of a shadow along a side of a pixel
_ORDERS = (17, 31, 43, 61, 73, 101)  # of uniformly redundant arrays


def drawn_kernels(
    rng: np.random.Generator, side: int, width: float, captures: int
) -> Float32[np.ndarray, "capture side side"]:
    """PSFs of one camera on a grid of `side` pixels, whose mask's shadow is some `width` wide.

    Six of ten single captures are of zone plates, two of uniformly redundant arrays, the others
    of random cells, diffusers or lenslets. Several are of zone plates in other phases, or of two
    plates or distances in two phases each. Their response to any frequency is at most 1 in all.
    """
    if captures > 1:
        kernels = _stack_of_zones(rng, side, width, captures)
    else:
        kinds = [_zones] * 6 + [_uniformly_redundant] * 2 + [_cells, _diffuser, _lenslets]
        draw: Callable[..., np.ndarray] = kinds[rng.integers(len(kinds))]
        kernels = draw(rng, side, width)[None]
    blur = rng.uniform(0, 0.9)  # of diffraction and the pixels
    kernels = np.stack([ndimage.gaussian_filter(kernel, blur) for kernel in kernels])
    response = np.sum(np.abs(np.fft.rfft2(kernels)) ** 2, axis=0).max() ** 0.5
    return (kernels / response).astype(np.float32)


def _places(side: int) -> np.ndarray:
    count = side * _FINER
    return (np.arange(count) - (count - 1) / 2) / _FINER


def _on_pixels(shadow: np.ndarray) -> np.ndarray:
    side = len(shadow) // _FINER
    return shadow.reshape(side, _FINER, side, _FINER).mean(axis=(1, 3))


def _zone_rate(rng: np.random.Generator, width: float) -> float:
    """β of cos(βr²), so that zones at the edge have 0.1 to 0.5 cycles per pixel."""
    return np.pi * np.exp(rng.uniform(np.log(0.1), np.log(0.5))) / (width / 2)


def _zone_plate(side: int, width: float, rate: float, phase: float, *, binary: bool) -> np.ndarray:
    squared = _places(side)[:, None] ** 2 + _places(side) ** 2
    plate = (1 + np.cos(rate * squared + phase)) / 2
    plate = (plate > 0.5).astype(float) if binary else plate
    return _on_pixels(plate * (squared < (width / 2) ** 2))


def _zones(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    phase = rng.uniform(0, 2 * np.pi) if rng.random() < 0.5 else 0.0
    return _zone_plate(side, width, _zone_rate(rng, width), phase, binary=rng.random() < 0.3)


def _stack_of_zones(
    rng: np.random.Generator, side: int, width: float, captures: int
) -> list[np.ndarray]:
    first = rate, width = _zone_rate(rng, width), width
    second = rate * np.exp(rng.uniform(-0.4, 0.4)), width * np.exp(rng.uniform(-0.2, 0.2))
    settings = [first] * captures if rng.random() < 0.4 else [first, second] * (captures // 2)
    turn = 2 * np.pi / captures if settings[0] == settings[-1] else np.pi / captures
    return [
        _zone_plate(side, wide, of, number * turn, binary=False)
        for number, (of, wide) in enumerate(settings)
    ]


def _enlarged(side: int, width: float, pattern: np.ndarray) -> np.ndarray:
    """Cells of a pattern, each at least a pixel wide."""
    count = len(pattern)
    cell = np.floor(_places(side) / max(width / count, 1.0) + count / 2).astype(int)
    inside = (cell >= 0) & (cell < count)
    cell = np.clip(cell, 0, count - 1)
    return _on_pixels(pattern[np.ix_(cell, cell)] * np.outer(inside, inside))


def _uniformly_redundant(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    """Modified uniformly redundant array (Gottesman, Fenimore, Appl. Opt. 28, 4344, 1989)."""
    order = int(rng.choice(_ORDERS))
    sign = np.full(order, -1)
    sign[np.arange(1, order) ** 2 % order] = 1
    pattern = (np.outer(sign, sign) > 0).astype(float)
    pattern[0], pattern[1:, 0] = 0, 1
    return _enlarged(side, width, np.roll(pattern, (order // 2, order // 2), (0, 1)))


def _cells(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    count = int(rng.integers(16, 120))
    is_open = rng.random((count, count)) < rng.uniform(0.15, 0.6)
    return _enlarged(side, width, is_open.astype(float))


def _diffuser(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    """Caustics: each ray is turned by the slope of a smooth relief."""
    count = int(width)
    squared = np.fft.fftfreq(count)[:, None] ** 2 + np.fft.fftfreq(count) ** 2
    smooth = np.exp(-rng.uniform(100, 1500) * squared)
    relief = np.fft.ifft2(np.fft.fft2(rng.standard_normal((count, count))) * smooth).real
    turn = np.exp(rng.uniform(np.log(8), np.log(60))) / relief.std()
    y, x = (np.indices((count, count))[k] + turn * np.gradient(relief, axis=k) for k in (0, 1))
    edges = np.arange(side + 1) - 0.5 - (side - count) / 2
    return np.histogram2d(y.ravel(), x.ravel(), [edges, edges])[0]


def _lenslets(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    image = np.zeros((side, side))
    middles = rng.uniform(-width, width, (int(rng.integers(8, 60)), 2)) / 2 + side / 2
    rows, columns = np.clip(middles, 0, side - 1).astype(int).T
    np.add.at(image, (rows, columns), rng.uniform(0.5, 1, len(rows)))
    return ndimage.gaussian_filter(image, rng.uniform(0.4, 1.5))
