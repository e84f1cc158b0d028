"""A scene with depth and colour, small enough for tests, and its camera."""

import numpy as np

import thincam_jax as tc
from thincam_jax.units import nm, um

SHAPE = (80, 96)


def camera(dtype=np.float64) -> tc.LenslessCamera:
    """The thesis' optics on a sensor of 80×96 pixels of 44 µm, off centre by a little."""
    mask = tc.FresnelZoneAperture(
        dtype(25.0), dtype(0.4), width=dtype(3.6), centre=np.array([0.1, -0.2], dtype)
    )
    sensor = tc.Sensor(SHAPE, dtype(44 * um), full_well=dtype(13_500.0), exposure=dtype(0.9))
    return tc.LenslessCamera(mask, sensor, dtype(6.5))


def scene(planes: int, colours: int, *, batch=(), dtype=np.float64) -> tc.Scene:
    """A textured patch in every plane, each elsewhere, as wide as the field allows."""
    random = np.random.default_rng(3)
    found = []
    for distance in np.geomspace(100.0, 10_000.0, planes):
        image = np.zeros((*batch, 48, 64))
        row, column = random.integers(0, 24), random.integers(0, 32)
        patch = random.uniform(size=(*batch, 24, 32)) + np.linspace(0, 2, 32)
        image[..., row : row + 24, column : column + 32] = patch
        found.append(tc.ImagePlane(image.astype(dtype), dtype(distance), dtype(0.15 * distance)))
    wavelengths = np.linspace(450 * nm, 650 * nm, colours).astype(dtype)
    weights = np.exp(-(((wavelengths - 550 * nm) / (60 * nm)) ** 2))
    return tc.Scene(found, tc.Spectrum(wavelengths, (weights / weights.sum()).astype(dtype)))
