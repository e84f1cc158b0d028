"""Random cameras before a few spots of a wide field, and their captures spot by spot."""

import math

import jax
import jax.numpy as jnp
import numpy as np

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.lensless.masks import random_cells
from thincam_jax.lensless.psf import psf_about_ray, spectral_psf
from thincam_jax.units import nm, um

# Of all cameras, so that they share their programs. The kernel's counts are odd: samples of the
# cells below then lie between their edges.
SENSOR, FIELD, SPOTS = (16, 20), (20, 26), 4
_SAMPLES, _STEPS = 15, 5


def random_case(random: np.random.Generator, kind: str):
    """A camera, a scene up to 45° wide, and a tolerance."""
    pitch = random.uniform(20, 60) * um
    distance = max(FIELD[1] / 2 * pitch, math.exp(random.uniform(math.log(0.7), math.log(8))))
    cell = random.choice([5, 7]) * pitch / _STEPS
    width = random.uniform(0.6, 1.3) * SENSOR[1] * pitch
    beta = math.pi * random.uniform(0.2, 0.9) / pitch / width
    heights = random.uniform(0, 1.0, (11, 11)) * um
    key = jax.random.key(int(random.integers(10**6)))
    mask = {
        "plate": lambda: tc.FresnelZoneAperture(beta, random.uniform(0, 6), width=width),
        "mura": lambda: tc.ModifiedUniformlyRedundantArray(11, cell),
        "random": lambda: random_cells(key, 11 * cell, cell),
        "phase": lambda: tc.PhaseMask(heights, cell, 1.5, interpolation="bilinear"),
    }[kind]()
    camera = tc.LenslessCamera(mask, tc.Sensor(SENSOR, pitch), distance)
    t = math.exp(random.uniform(math.log(50), math.log(2000)))
    image = np.zeros(FIELD)
    for _ in range(SPOTS):
        image[random.integers(FIELD[0]), random.integers(FIELD[1])] += random.uniform(0.2, 1)
    plane = tc.ImagePlane(image, t, FIELD[1] * pitch / distance * t)
    scene = tc.Scene(plane, random.uniform(400, 700) * nm)
    return camera, scene, math.exp(random.uniform(math.log(2e-3), math.log(0.3)))


def captured(camera, scene, kind: str):
    """The sum over the spots, each with its PSF and light.

    Of a mask that is sampled, what the samples leave out on the axis is put back.
    """
    (plane,), (wavelength,) = scene.planes, scene.spectrum.wavelengths
    wide = camera.on_grid(kernel_grid(camera.sensor.grid, FIELD))
    pitch, distance = float(camera.sensor.pitch), float(camera.distance)
    fine = tc.PsfMethod("separable", pixel_integration=True, nodes=89)
    if kind != "plate":
        fine = tc.PsfMethod("angular_spectrum", "float32", True, oversampling=_SAMPLES)
    light, total = np.asarray(plane.image)[::-1, ::-1], np.zeros(SENSOR)
    for row, column in np.argwhere(light):
        y = (row - (FIELD[0] - 1) / 2) * pitch / distance
        x = (column - (FIELD[1] - 1) / 2) * pitch / distance
        at = (-float(plane.distance) * y, -float(plane.distance) * x)
        h = np.asarray(psf_about_ray(wide, wavelength, plane.distance, at, fine), float)
        own = h[FIELD[0] - 1 - row :, FIELD[1] - 1 - column :][: SENSOR[0], : SENSOR[1]]
        total += light[row, column] * pitch**2 * (1 + y**2 + x**2) ** -2 * own
    if kind == "plate":
        return total
    h = spectral_psf(wide, [(wavelength, 1.0)], plane.distance, fine, wide.sensor.grid)
    left = CropConvolution(h, wide.sensor.pitch, SENSOR, FIELD)(jnp.asarray(light, h.dtype))
    finer = tc.PsfMethod("angular_spectrum", oversampling=2 * _SAMPLES + 1)
    model = finer if kind == "phase" else "separable"
    return total - np.asarray(left, float) + np.asarray(tc.capture(camera, scene, model=model))


def errors(count: int, seed: int, kind: str) -> np.ndarray:
    """(tolerance, predicted, true, choice, met) of so many cameras; choices: 0 axis, 1 its PSF."""
    random, found = np.random.default_rng(seed), []
    for _ in range(count):
        camera, scene, tolerance = random_case(random, kind)
        plan = tc.plan_capture(camera, scene, tolerance=tolerance)
        own = plan.method.field_tolerance
        choice = 0 if own is None else 1 if own >= 1 else 2
        capture = np.asarray(tc.capture(camera, scene, model=plan), float)
        true = relative_l2(capture, captured(camera, scene, kind))
        found.append((tolerance, plan.predicted_error, true, choice, plan.meets_tolerance))
    return np.array(found, float)
