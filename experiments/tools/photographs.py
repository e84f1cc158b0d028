"""Photographs for designs: squares or rectangles of one brightness, in twice the field's pixels."""

import os
from pathlib import Path

import numpy as np

from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.imaging.targets.images import load_image, sample_images

# Drawings, and pictures that a design was tuned by.
_OTHERS = "camera", "rocket", "coins", "cell", "cat", "colorwheel", "logo", "text"


def photographs(count: int, field: tuple[int, int], mean: float = 0.4) -> np.ndarray:
    """Light (photograph, 2 y, 2 x) of the first sample images, cut to the field (y, x).

    More than these come from the folder `cc0` in that of THINCAM_PHOTOGRAPHS; without, they are
    fewer. Codes of sample images are taken as light, those of the folder are decoded.
    """
    names = [name for name in sample_images() if name not in _OTHERS][:count]
    images = [sample_image(name, linear=True) for name in names]
    if folder := os.environ.get("THINCAM_PHOTOGRAPHS"):
        files = sorted(Path(folder, "cc0").glob("*.png"))
        images += [load_image(file) for file in files[: count - len(images)]]
    return np.stack([fitted(image, field, mean) for image in images]).astype(np.float32)


def fitted(image: np.ndarray, field: tuple[int, int], mean: float = 0.4) -> np.ndarray:
    """The middle of an image, in twice the field's pixels."""
    image = np.atleast_3d(image).mean(-1)
    high, wide = (round(min(np.divide(image.shape, field)) * n) for n in field)
    top, left = (image.shape[0] - high) // 2, (image.shape[1] - wide) // 2
    image = resize(image[top : top + high, left : left + wide], (2 * field[0], 2 * field[1]))
    return image * mean / image.mean()


def halved(images):
    """Means over 2 × 2 pixels."""
    return images.reshape(*images.shape[:-2], images.shape[-2] // 2, 2, -1, 2).mean((-3, -1))
