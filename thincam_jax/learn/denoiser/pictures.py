"""Pictures to learn denoising from: photographs at several scales and drawn scenes, in tiles."""

import hashlib
import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from thincam_jax.imaging.encoding import decode_srgb
from thincam_jax.imaging.targets import resize
from thincam_jax.learn.sources import Entry, dead_leaves, read_photographs, read_samples

TILE = 192  # pixels
# Reduced photographs are sharper and hold less noise of their own; each halves the number of tiles.
_SCALES = (1.0, 0.7, 0.5, 0.35)


Cut = Callable[[np.ndarray], np.ndarray]  # tiles of an image in linear light


@dataclass(frozen=True, eq=False)
class Pictures:
    """Square tiles of pictures, linear radiance from 0 to 1 in three colours, and their origin."""

    tiles: Float32[np.ndarray, "tile side side 3"]
    manifest: tuple[Entry, ...]


def photographs(
    folder: str | os.PathLike[str], *, licence: str = "", cut: Cut | None = None
) -> dict[str, Pictures]:
    """Each image of a folder at several scales, by its name without the suffix.

    - `licence`: default the first line of the folder's LICENSE file, else "unknown".
    - `cut`: another choice of tiles.
    """
    read = read_photographs(folder, licence)
    return {Path(entry.name).stem: _cut(image, entry, cut) for image, entry in read}


def samples(cut: Cut | None = None) -> dict[str, Pictures]:
    """scikit-image's own photographs in the same way."""
    return {entry.name: _cut(image, entry, cut) for image, entry in read_samples()}


def drawn(seed: int, count: int) -> Pictures:
    """Half dead leaves, half rows of strokes on a gradient, the same for the same seed."""
    written = [_written(np.random.default_rng((seed, n))) for n in range(count // 2)]
    images = [*dead_leaves(seed, count - count // 2, TILE), *written]
    tiles = np.stack([np.repeat(image[..., None], 3, axis=-1) for image in images])
    digest = hashlib.sha256(tiles.tobytes()).hexdigest()
    name = f"dead leaves and strokes, seed {seed}, {count} images"
    return Pictures(tiles.astype(np.float32), (Entry(name, digest, "drawn"),))


def united(pictures: Iterable[Pictures]) -> Pictures:
    """All of them as one."""
    pictures = list(pictures)
    tiles = np.concatenate([one.tiles for one in pictures])
    return Pictures(tiles, tuple(entry for one in pictures for entry in one.manifest))


def split(
    named: dict[str, Pictures], held_out: Collection[str]
) -> tuple[list[Pictures], list[Pictures]]:
    """Pictures to train on, and those of the names that are held out.

    **Errors**: ValueError for a name that is not there.
    """
    unknown = sorted({*held_out} - {*named})
    if unknown:
        raise ValueError(f"held_out names {unknown[0]!r}; there are {', '.join(named)}")
    kept = [one for name, one in named.items() if name not in held_out]
    return kept, [named[name] for name in held_out]


def _cut(image: np.ndarray, entry: Entry, cut: Cut | None) -> Pictures:
    linear = decode_srgb(image if image.ndim == 3 else np.stack([image] * 3, axis=-1))
    return Pictures((cut or _at_scales)(linear), (entry,))


def _at_scales(linear: np.ndarray) -> np.ndarray:
    """Tiles that cover an image at each scale at which it holds one."""
    tiles: list[np.ndarray] = []
    for scale in _SCALES:
        rows, columns = (round(scale * side) for side in linear.shape[:2])
        if min(rows, columns) < TILE and tiles:
            break
        size = max(rows, TILE), max(columns, TILE)
        reduced = resize(linear, size).astype(np.float32)
        for top in _places(size[0]):
            tiles += [reduced[top : top + TILE, at : at + TILE] for at in _places(size[1])]
    return np.stack(tiles)


def _places(side: int) -> list[int]:
    """First pixels of tiles that cover a side evenly."""
    return np.linspace(0, side - TILE, -(-side // TILE)).round().astype(int).tolist()


def _written(rng: np.random.Generator) -> np.ndarray:
    """Rows of strokes like a text's, on a ground whose radiance changes linearly."""
    y, x = np.mgrid[:TILE, :TILE].astype(np.float32) / TILE - 0.5
    angle = rng.uniform(0, 2 * np.pi)
    ground = rng.uniform(0.05, 1) * (
        1 + rng.uniform(0, 1) * (x * np.cos(angle) + y * np.sin(angle))
    )
    ink = np.zeros((TILE, TILE), np.float32)
    height = int(np.exp(rng.uniform(np.log(6), np.log(48))))
    weight = max(0.6, height * rng.uniform(0.05, 0.12))
    for top in range(int(rng.integers(height)), TILE - height, int(1.6 * height)):
        left = float(rng.uniform(0, height))
        while left < TILE - height:
            corners = rng.integers(0, 3, (int(rng.integers(2, 6)), 2)) / 2 * (height, 0.6 * height)
            for start, end in zip(corners, corners[1:], strict=False):
                _stroke(ink, start + (top, left), end + (top, left), weight)
            left += height * rng.uniform(0.7, 1.3)
    ink = ink * rng.uniform(0.3, 1)
    colour = rng.uniform(0, 1) ** 2.2
    return np.clip(ground + ink * (colour - ground), 0, 1).astype(np.float32)


def _stroke(ink: np.ndarray, start: np.ndarray, end: np.ndarray, weight: float) -> None:
    """A straight stroke of that half width, with edges of one pixel."""
    low = np.floor(np.minimum(start, end) - weight - 1).clip(0).astype(int)
    high = np.ceil(np.maximum(start, end) + weight + 2).astype(int)
    part = ink[low[0] : high[0], low[1] : high[1]]
    place = np.moveaxis(np.indices(part.shape), 0, -1) + low - start
    along = end - start
    share = (place @ along / max(float(along @ along), 1e-6)).clip(0, 1)
    distance = np.linalg.norm(place - share[..., None] * along, axis=-1)
    np.maximum(part, (weight + 0.5 - distance).clip(0, 1), out=part)
