"""Simulated files of a lensless camera: a PSF of spots and captures of blobs, seeded and small."""

from pathlib import Path

import numpy as np
import PIL.Image
import scipy.ndimage
import scipy.signal
import tifffile

SHAPE = (60, 76)
DARK = 40  # counts of 4095
COLOURS = ((0.9, 0.7, 0.2), (0.3, 0.8, 0.9))  # of the two blobs


def psf(shape=SHAPE, spots=18, seed=1):
    """Spots in the middle of the sensor, sum 1."""
    generator = np.random.default_rng(seed)
    points = np.zeros(shape)
    rows, columns = (generator.integers(n // 4, 3 * n // 4, spots) for n in shape)
    points[rows, columns] = generator.uniform(0.5, 1, spots)
    light = scipy.ndimage.gaussian_filter(points, 1.0)
    return light / light.sum()


def scene(shape=SHAPE, shift=0):
    """Two discs of the `COLOURS` on black, (3, y, x); no symmetry."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    image = np.zeros((3, *shape))
    for colour, (y0, x0, radius) in zip(COLOURS, ((-5, -8 + shift, 9), (7, 9, 5)), strict=True):
        disc = (y[:, None] - y0) ** 2 + (x - x0) ** 2 < radius**2
        image += disc * np.array(colour)[:, None, None]
    return image


def capture(image, light):
    """What the sensor sees: a linear convolution, cropped so that the middle of the field of
    sensor + PSF − 1 samples lies in front of it."""
    first = [n // 2 for n in light.shape]
    whole = np.stack([scipy.signal.fftconvolve(plane, light) for plane in image])
    rows, columns = image.shape[-2:]
    return whole[:, first[0] : first[0] + rows, first[1] : first[1] + columns]


def counts(light, seed=2, full=3600, noise=2.0):
    """12 bit: dark level, signal and noise; the brightest at `full` above the dark level."""
    generator = np.random.default_rng(seed)
    clean = DARK + full * np.asarray(light) / np.max(light)
    return np.clip(np.round(clean + noise * generator.normal(size=clean.shape)), 0, 4095)


def grey_files(folder: Path, captures=("capture",), shape=SHAPE) -> dict[str, Path]:
    """psf.tif, dark.tif and a capture of each name, 12 bit in 16."""
    light = psf(shape)
    images = {"psf": counts(light, 3), "dark": np.full(shape, DARK)}
    for number, name in enumerate(captures):
        view = capture(scene(shape, 3 * number)[1:2], light)
        images[name] = counts(view[0], 10 + number)
    return {name: write_tiff(folder / f"{name}.tif", image) for name, image in images.items()}


def colour_files(folder: Path) -> dict[str, Path]:
    """8-bit PNGs: psf.png and grey_psf.png, and capture.png in the colours of the scene."""
    light = psf()
    images = {
        "psf": np.stack([counts(light, 4 + c) for c in range(3)], -1),
        "grey_psf": counts(light, 7),
        "capture": np.moveaxis(counts(capture(scene(), light), 8), 0, -1),
    }
    paths = {}
    for name, image in images.items():
        paths[name] = folder / f"{name}.png"
        PIL.Image.fromarray((image / 16).astype(np.uint8)).save(paths[name])
    return paths


def bayer_files(folder: Path, shape=(120, 152)) -> dict[str, Path]:
    """psf.tif, dark.tif and capture.tif of an RGGB sensor, 12 bit; the same scene."""
    light = scipy.ndimage.gaussian_filter(np.kron(psf(), np.ones((2, 2))), 1.0)
    view = capture(np.kron(scene(), np.ones((2, 2))), light / light.sum())
    images = {
        "psf": counts(light, 5),
        "capture": mosaic(counts(view, 6)),
        "dark": np.full(shape, DARK),
    }
    return {name: write_tiff(folder / f"{name}.tif", image) for name, image in images.items()}


def mosaic(image):
    """RGGB of (3, y, x)."""
    raw = np.array(image[1])
    raw[::2, ::2] = image[0, ::2, ::2]
    raw[1::2, 1::2] = image[2, 1::2, 1::2]
    return raw


def correlation(image, other) -> float:
    return float(np.corrcoef(np.ravel(image), np.ravel(other))[0, 1])


def write_tiff(path: Path, image) -> Path:
    tifffile.imwrite(path, np.asarray(image).astype(np.uint16))
    return path
