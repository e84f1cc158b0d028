"""Images to learn from and to judge by: photographs, scikit-image's own, drawn ones."""

import hashlib
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from thincam_jax._core.files import file_digest, photograph_files, read_regular
from thincam_jax.imaging.encoding import decode_srgb
from thincam_jax.imaging.targets import middle_square, resize, sample_image
from thincam_jax.imaging.targets.images import load_image

_SMALLEST, _LARGEST = 1.5, 0.45  # radii: pixels, and parts of the image


def dead_leaves(seed: int, count: int, side: int) -> Float32[np.ndarray, "count y x"]:
    """`count` drawn images of radiance 0 to 1, side × side pixels; the same for the same seed.

    Discs, ellipses and rectangles fall on each other until nothing of the ground is left in most
    places. Their radii have the density r⁻³, so that enlarging an image gives one of the same kind,
    with the power spectrum of photographs, about 1/ρ² (Lee, Mumford, Huang, Int. J. Comput. Vision
    41, 35, 2001). Each has a radiance, a slope of it and sometimes stripes or grain.
    """
    if count < 1 or side < 8:
        raise ValueError(f"count = {count}, side = {side}; give at least 1 image of 8 pixels")
    return np.stack([_one(np.random.default_rng((seed, n)), side) for n in range(count)])


def _one(rng: np.random.Generator, side: int) -> Float32[np.ndarray, "y x"]:
    image = np.full((side, side), rng.uniform(0, 1) ** 2.2, np.float32)
    number = int(rng.integers(60, 500))
    # Of the density r⁻³ between both ends, by its inverse distribution function.
    share = rng.uniform(size=number)
    ends = _SMALLEST**-2.0, (_LARGEST * side) ** -2.0
    radii = (ends[0] + share * (ends[1] - ends[0])) ** -0.5
    if rng.uniform() < 0.5:  # large ones behind: small detail stays to be seen
        radii = np.sort(radii)[::-1]
    for radius in radii:
        _drop(image, rng, float(radius))
    return image


def _drop(image: np.ndarray, rng: np.random.Generator, radius: float) -> None:
    """Paints one leaf."""
    side = image.shape[0]
    y, x = rng.uniform(-radius / 2, side + radius / 2, 2)
    reach = 1.5 * radius
    top, bottom = max(0, int(y - reach)), min(side, int(y + reach) + 2)
    left, right = max(0, int(x - reach)), min(side, int(x + reach) + 2)
    if top >= bottom or left >= right:
        return
    angle, aspect = rng.uniform(0, np.pi), rng.uniform(0.35, 1)
    down = np.arange(top, bottom, dtype=np.float32)[:, None] - np.float32(y)
    across = np.arange(left, right, dtype=np.float32) - np.float32(x)
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    u = (across * cosine + down * sine) / np.float32(radius)
    v = (down * cosine - across * sine) / np.float32(radius * aspect)
    level = np.maximum(abs(u), abs(v)) if rng.uniform() < 0.4 else np.hypot(u, v)
    cover = np.clip((1 - level) * np.float32(radius * aspect) + 0.5, 0, 1)
    # Photographs hold more dark than bright in linear light.
    colour = rng.uniform(0, 1) ** 2.2 * (1 + rng.uniform(-0.5, 0.5) * u)
    kind = rng.uniform()
    if kind < 0.2:
        period = rng.uniform(0.15, 0.8)
        colour = colour * (1 + rng.uniform(0.2, 0.8) * np.sin(2 * np.pi / period * v))
    elif kind < 0.4:
        colour = colour * (1 + 0.25 * rng.standard_normal(cover.shape))
    part = image[top:bottom, left:right]
    part += cover * (np.clip(colour, 0, 1).astype(np.float32) - part)


# Photographs that ship with scikit-image.
_SAMPLES = (
    *("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "gravel"),
    *("rocket",),
)
_LICENCE_FILES = ("LICENSE", "LICENSE.txt", "LICENSE.md", "COPYING")


@dataclass(frozen=True)
class Entry:
    """One image of a source: its name, the SHA-256 of what it was read from, and its licence."""

    name: str
    sha256: str
    licence: str


def as_json(images: dict[str, tuple[Entry, ...]]) -> dict[str, list[dict[str, str]]]:
    """Entries of images by their use, for a JSON file."""
    return {use: [asdict(entry) for entry in entries] for use, entries in images.items()}


def from_json(images: dict[str, list[dict[str, str]]]) -> dict[str, tuple[Entry, ...]]:
    """Entries of `as_json`."""
    return {use: tuple(Entry(**one) for one in entries) for use, entries in images.items()}


def photographs(
    folder: str | os.PathLike[str], side: int
) -> Float32[np.ndarray, "image side side"]:
    """The images of a folder, in the order of their names: linear radiance from 0 to 1.

    sRGB is linearised, colours become luminance, and the middle square is reduced to `side` pixels.
    """
    return np.stack([_square(image, side) for image, _ in read_photographs(folder)])


def read_photographs(
    folder: str | os.PathLike[str], licence: str = ""
) -> list[tuple[np.ndarray, Entry]]:
    """The images of a folder as in their files, from 0 to 1.

    `licence`: default the first line of the folder's LICENSE file, else "unknown".
    """
    files = photograph_files(folder)
    licence = licence or _licence(Path(folder))
    entries = [Entry(path.name, file_digest(path), licence) for path in files]
    return [
        (load_image(path, linear=True), entry) for path, entry in zip(files, entries, strict=True)
    ]


def read_samples() -> list[tuple[np.ndarray, Entry]]:
    """scikit-image's own photographs as in their files, from 0 to 1."""
    images = [sample_image(name, linear=True) for name in _SAMPLES]
    digests = [hashlib.sha256(image.tobytes()).hexdigest() for image in images]
    licence = "scikit-image's own (its data folder's README)"
    named = zip(_SAMPLES, digests, strict=True)
    entries = [Entry(f"skimage:{name}", digest, licence) for name, digest in named]
    return list(zip(images, entries, strict=True))


def _square(image: np.ndarray, side: int) -> Float32[np.ndarray, "side side"]:
    linear = decode_srgb(image)
    if linear.ndim == 3:
        linear = linear @ np.array([0.2126, 0.7152, 0.0722])  # luminance of sRGB's primaries
    square = middle_square(linear, min(linear.shape))
    return resize(square, (side, side)).astype(np.float32)


def _licence(folder: Path) -> str:
    for name in _LICENCE_FILES:
        if (folder / name).is_file():
            lines = read_regular(folder / name, 2**20).decode("utf-8", "replace").splitlines()
            return next((line.strip() for line in lines if line.strip()), "unknown")
    return "unknown"
