r"""Captures at a few frequencies: how an error of the PSF shows in the image of this scene.

A capture is a linear convolution, so that by Parseval its energy is
:math:`\iint |\sum_t H_t F_t|^2\,dv\,du` over the frequencies of the samples. The integral is taken
at a few hundred random ones, closer together towards zero, where scenes have their light.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

# Rings of frequencies, and frequencies in each.
_RINGS, _IN_RING = 32, 16


class Frequencies(NamedTuple):
    """Frequencies in cycles per sample, and the area that each stands for.

    - `v`, `u`: down and across; of a pair of opposite frequencies one stands for both.
    - `weights`: areas; together 1, the whole band.
    """

    v: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " k"]


def sample_frequencies(longest: int, seed: int = 0) -> Frequencies:
    """Stratified over rings that grow geometrically from a quarter of 1/`longest`."""
    random = np.random.default_rng(seed)
    edges = [0.0, *np.geomspace(min(0.25 / longest, 0.25), 0.5, _RINGS - 1), math.sqrt(0.5)]
    found = [_ring(random, low, high) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    v, u, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Frequencies(v, u, weights / weights.sum())


def _ring(random, low: float, high: float):
    """Frequencies of one ring inside the square band, and the ring's area shared among them."""
    tried = 4096 if high > 0.5 else _IN_RING
    radius = np.sqrt(random.uniform(low**2, high**2, tried))
    angle = random.uniform(-np.pi / 2, np.pi / 2, tried)
    v, u = radius * np.sin(angle), radius * np.cos(angle)
    inside = (np.abs(v) < 0.5) & (u < 0.5)
    area = np.pi * (high**2 - low**2) * inside.mean()
    v, u = v[inside][:_IN_RING], u[inside][:_IN_RING]
    return v, u, np.full(len(v), area / len(v))


def waves(
    frequencies: Float[np.ndarray, " k"], indices: Float[np.ndarray, " n"], length: int
) -> Float[np.ndarray, "length k2"]:
    """cos and −sin of the frequencies at centred indices, side by side; zero beyond them."""
    phase = 2 * np.pi * indices[:, None] * frequencies
    filled = np.zeros((length, 2 * len(frequencies)))
    filled[: len(indices)] = np.concatenate([np.cos(phase), -np.sin(phase)], axis=1)
    return filled


def centred(count: int) -> Float[np.ndarray, " n"]:
    return np.arange(count) - (count - 1) / 2


def image_spectrum(
    images: Float[np.ndarray, "batch m n"], frequencies: Frequencies
) -> Complex[np.ndarray, "batch k"]:
    """F(v, u) = Σ f e^{−2πj(vy+ux)} of images about their centres."""
    rows, columns = (centred(n) for n in images.shape[-2:])
    # cos and −sin side by side: one real product, at half the cost of a complex one.
    half = images @ waves(frequencies.u, columns, len(columns))
    cosine, sine = np.split(half, 2, axis=-1)
    down = np.exp(-2j * np.pi * np.outer(rows, frequencies.v))
    return np.einsum("bmk,mk->bk", cosine + 1j * sine, down)
