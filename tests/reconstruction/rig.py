"""A small rig that the reconstruction tests share: 96×85 pixels of 25 µm, masks of 2 mm.

β·(width/2)² = 30 rad; zones at the edge of 9.5 cycles/mm and twice that for the second harmonic,
Nyquist 20. A scene pixel of 0.833 mm at 100 mm projects on one pixel of the camera at d = 3 mm.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.units import nm, um

SENSOR = tc.Sensor((96, 85), 25 * um)
FIELD = (40, 47)
DISTANCE, OBJECT_DISTANCE, WAVELENGTH = 3.0, 100.0, 500 * nm
OBJECT_PITCH = 25 * um * OBJECT_DISTANCE / DISTANCE


def camera(phase=0.0, *, beta=30.0, distance=DISTANCE, width=2.0, sensor=SENSOR, **mask):
    aperture = tc.FresnelZoneAperture(beta, phase, width=width, **mask)
    return tc.LenslessCamera(mask=aperture, sensor=sensor, distance=distance)


def phases(count=4, **settings):
    """Cameras with the phases 0, π/2, π, 3π/2."""
    return [camera(k * math.pi / 2, **settings) for k in range(count)]


def pair(**settings):
    """Cameras with the phases 0 and 3π/2."""
    return [camera(0.0, **settings), camera(1.5 * math.pi, **settings)]


def picture(shape=FIELD):
    """Soft blobs on a ground, brighter to the left and below: no symmetry, nothing above 8 c/mm."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    image = np.full(shape, 0.3)
    for gain, y0, x0, size in ((0.9, 9, -12, 3.0), (0.6, -10, -5, 2.2), (0.4, -3, 13, 4.0)):
        image += gain * np.exp(-((y[:, None] - y0) ** 2 + (x - x0) ** 2) / (2 * size**2))
    return image


def scene(image, pitch=OBJECT_PITCH, wavelength=WAVELENGTH, distance=OBJECT_DISTANCE):
    # Captures are linear, and tests look at scenes without a mean, too.
    plane = tc.ImagePlane(np.ones_like(image, float), distance, pitch * np.shape(image)[-1])
    plane = eqx.tree_at(lambda plane: plane.image, plane, jnp.asarray(image, float))
    return tc.Scene(plane, wavelength)


def captures(cameras, image, *, model="geometric", **where):
    """Noise-free captures; not averaged over the pixels, which compiles much faster."""
    view = scene(image, **where)
    return jnp.stack([tc.capture(c, view, model=model, pixel_integration=False) for c in cameras])


def imaging_model(cameras, **settings) -> tc.Cameras:
    """Cameras in the light of `scene`, with the PSFs that `captures` is made with."""
    usual = {
        "wavelength": WAVELENGTH,
        "object_distance": OBJECT_DISTANCE,
        "field_shape": FIELD,
        "model": "geometric",
        "pixel_integration": False,
    }
    return tc.Cameras(cameras, **(usual | settings))


def correlation(image, other) -> float:
    return float(np.corrcoef(np.ravel(image), np.ravel(other))[0, 1])


def centroid(reconstruction, reach=3):
    """Place of the brightest spot, (y, x) in mm on the object, to a fraction of a pixel."""
    image = np.asarray(reconstruction.image)
    row, column = np.unravel_index(np.argmax(image), image.shape)
    rows, columns = (
        np.arange(row - reach, row + reach + 1),
        np.arange(column - reach, column + reach + 1),
    )
    spot = np.maximum(image[np.ix_(rows, columns)] - 0.2 * image.max(), 0.0)
    y, x = (rows - (image.shape[0] - 1) / 2), (columns - (image.shape[1] - 1) / 2)
    place = np.array([spot.sum(1) @ y, spot.sum(0) @ x]) / spot.sum()
    return place * float(reconstruction.pitch)


class unchecked:  # noqa: N801
    """Without the tests' type checker, which would refuse a bad choice before the package does."""

    def __enter__(self):
        jaxtyping.config.update("jaxtyping_disable", True)

    def __exit__(self, *_):
        jaxtyping.config.update("jaxtyping_disable", False)


def refused(message, make, kind=ValueError):
    """What is made raises, and one line says what is wrong."""
    with unchecked(), pytest.raises(kind, match=message) as error:
        make()
    assert "\n" not in str(error.value)
