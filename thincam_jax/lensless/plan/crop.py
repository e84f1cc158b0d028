"""How much of a capture's energy the sensor catches."""

import math

import numpy as np
from jaxtyping import Float

from thincam_jax.lensless.camera import LenslessCamera

# Points across the shadow and the sensor at which the energy is counted.
_POINTS = 96


def crop_factor(
    camera: LenslessCamera, distance: float, images: Float[np.ndarray, "batch m n"]
) -> float:
    """‖g‖₂ of the whole image over that of its part on the sensor, at least 1.

    Infinite where no light falls on the sensor but what is diffracted there.
    Errors are known for the whole image; this bounds them on the sensor. The mask's shadow without
    its fringes, a box, stands for the PSF: its convolution is a difference of running sums.
    """
    pitch = float(camera.sensor.pitch)
    scale = 1 + float(camera.distance) / distance
    box = [scale * float(extent) / pitch for extent in camera.mask.extent]
    offset = [scale * float(c) / pitch for c in camera.mask.centre]
    kernel = [n + s - 1 for n, s in zip(images.shape[-2:], camera.sensor.shape, strict=True)]
    # The PSF is only known, and only needed, on the kernel's grid.
    low = [max(o - b / 2, -k / 2) for o, b, k in zip(offset, box, kernel, strict=True)]
    high = [min(o + b / 2, k / 2) for o, b, k in zip(offset, box, kernel, strict=True)]
    if any(top <= bottom for bottom, top in zip(low, high, strict=True)):
        return math.inf
    running = np.pad(images.cumsum(axis=-1).cumsum(axis=-2), ((0, 0), (1, 0), (1, 0)))
    sizes = images.shape[-2:]
    whole = [
        np.linspace(bottom - n / 2, top + n / 2, _POINTS)
        for bottom, top, n in zip(low, high, sizes, strict=True)
    ]
    sensor = [np.linspace(-n / 2, n / 2, _POINTS) for n in camera.sensor.shape]
    energies = [_energy(running, points, low, high) for points in (whole, sensor)]
    return max(1.0, math.sqrt(energies[0] / energies[1])) if energies[1] > 0 else math.inf


def _energy(running, points, low, high) -> float:
    """∬ of the squared convolution over the rectangle of the points."""
    sizes = [n - 1 for n in running.shape[-2:]]
    ends = [
        [np.clip(np.round(p - edge + n / 2).astype(int), 0, n) for edge in (top, bottom)]
        for p, bottom, top, n in zip(points, low, high, sizes, strict=True)
    ]
    (first_row, last_row), (first, last) = ends

    def corner(rows, columns):
        return running[:, rows[:, None], columns]

    image = corner(last_row, last) - corner(first_row, last)
    image = image - corner(last_row, first) + corner(first_row, first)
    area = math.prod(float(p[-1] - p[0]) for p in points)
    return float(np.mean(image**2)) * area
