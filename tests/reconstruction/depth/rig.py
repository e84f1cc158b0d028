"""A small camera that the depth tests share, and objects at distances of their own.

96×112 pixels of 20 µm behind a mask of 1.92 mm at d = 5 mm, β = 80 rad/mm². Zones at the edge of 24
cycles/mm, Nyquist 25; the depth of focus is 5.6 mm at t = 20 mm and 21 mm at 45 mm.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

import thincam_jax as tc
from thincam_jax.units import nm, um

WAVELENGTH = 500 * nm
SENSOR, PITCH, DISTANCE, BETA, WIDTH = (96, 112), 20 * um, 5.0, 80.0, 1.92
FIELD = (48, 56)


def cameras(distance=DISTANCE, beta=BETA):
    """Cameras with the phases 0, π/2, π, 3π/2."""
    sensor = tc.Sensor(SENSOR, PITCH)
    return [
        tc.LenslessCamera(
            tc.FresnelZoneAperture(beta, k * math.pi / 2, width=WIDTH), sensor, distance
        )
        for k in range(4)
    ]


def plane(image, object_distance, distance=DISTANCE):
    """A picture on the field's grid of directions, at a distance."""
    width = image.shape[1] * PITCH * object_distance / distance
    return tc.ImagePlane(image, object_distance, width)


def captures(cams, planes, *, snr_db=30.0, seed=0, model="separable"):
    scene, key = tc.Scene(planes, WAVELENGTH), jax.random.key(seed)
    return jnp.stack(
        [
            tc.capture(
                camera,
                scene,
                model=model,
                pixel_integration=False,
                key=jax.random.fold_in(key, k),
                noise=tc.GaussianNoise(snr_db),
            )
            for k, camera in enumerate(cams)
        ]
    )


def imaging_model(cams, **settings) -> tc.Cameras:
    """Cameras in the light of `captures`, focused where a sweep or a test says."""
    usual = {"wavelength": WAVELENGTH, "field_shape": FIELD, "pixel_integration": False}
    return tc.Cameras(cams, **(usual | settings))


def shapes():
    """Three bright shapes on black, none above another, each with edges and detail: (3, y, x)."""
    y, x = np.mgrid[: FIELD[0], : FIELD[1]]
    images = np.zeros((3, *FIELD))
    images[0, 8:20, 6:20] = 1.0
    images[0, 12:16, 10:16] = 0.4
    images[1] = 0.9 * ((y - 32) ** 2 + (x - 28) ** 2 < 64)
    images[2, 10:24, 38:50] = 0.5
    images[2, 10:24, 42:44] = images[2, 10:24, 47:49] = 1.0
    return images


def checks(box, period=4):
    """A field that is black but for a chequered box (rows, columns)."""
    y, x = np.mgrid[: FIELD[0], : FIELD[1]]
    image = np.zeros(FIELD)
    pattern = 0.3 + 0.7 * ((y // (period // 2) + x // period) % 2)
    image[box] = pattern[box]
    return image
