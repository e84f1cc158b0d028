"""Plans of masks without few terms: predicted errors against many more samples of all light."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.lensless.forward import project, projected_shape
from thincam_jax.lensless.masks.display import on_display
from thincam_jax.lensless.masks.phase import MaskBlank, diffuser, voronoi_fresnel
from thincam_jax.lensless.psf import spectral_psf
from thincam_jax.units import nm, um

KEY, BLANK = jax.random.key(11), MaskBlank((40, 48), 5 * um, 1.5)
MASKS = {
    "diffuser": lambda: diffuser(KEY, BLANK, correlation_length=20 * um, rms_slope=0.02),
    "lenses": lambda: voronoi_fresnel(KEY, BLANK, sites=3, focal_length=4.0, wavelength=532 * nm),
    "rings": lambda: tc.RadialMask(np.random.default_rng(0).uniform(0, 1, 12), 10 * um),
    "display": lambda: on_display(MASKS["diffuser"](), 10 * um, 0.8),
}
LIGHT = tc.Spectrum(np.linspace(500, 560, 3) * nm)
DISTANCES = (20.0, 60.0, 200.0)


def camera(name):
    return tc.LenslessCamera(MASKS[name](), tc.Sensor((36, 40), 5 * um), 4.0)


def deep():
    image = resize(sample_image("camera", linear=True), (40, 44))
    return tc.Scene(
        [tc.ImagePlane(image * (1 + t / 100), t, 0.15 * t / 4) for t in DISTANCES], LIGHT
    )


def reference(here, scene, samples):
    """All light by so many samples, in a window of some three times the width."""
    total = 0.0
    for plane in scene.planes:
        field = projected_shape(here, plane)
        grid = kernel_grid(here.sensor.grid, field)
        kernel = spectral_psf(
            here,
            zip(LIGHT.wavelengths, LIGHT.weights, strict=True),
            plane.distance,
            tc.PsfMethod("angular_spectrum", None, True, samples, (120, 128)),
            grid,
        )
        convolution = CropConvolution(kernel, grid.pitch, here.sensor.shape, field)
        total = total + convolution(project(here, plane, field))
    return total


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "samples"), [("diffuser", 9), ("rings", 9), ("lenses", 15), ("display", 11)]
)
def test_predicted_error_is_at_least_the_true_one(optimised, name, samples):
    here, scene = camera(name), deep()
    true = reference(here, scene, samples)
    plan = tc.plan_capture(here, scene, tolerance=0.05)
    found = relative_l2(tc.capture(here, scene, model=plan), true)
    expected = "radial" if name == "rings" else "angular_spectrum"
    assert plan.method.model == expected and plan.meets_tolerance
    assert found < plan.predicted_error <= 0.05
    assert plan.predicted_error < 50 * found
    assert len(plan.distances) * len(plan.wavelengths) < 9


@pytest.mark.thorough
def test_a_plan_runs_inside_jit():
    """Of a few pixels; all light of nine samples a pixel is within what is predicted."""
    mask = tc.PhaseMask(np.random.default_rng(1).uniform(0, 4e-4, (6, 8)), 10 * um, 1.5)
    here = tc.LenslessCamera(mask, tc.Sensor((12, 14), 10 * um), 2.0)
    image = np.random.default_rng(2).uniform(0, 1, (9, 11))
    scene = tc.Scene([tc.ImagePlane(image, t, 0.05 * t) for t in (50.0, 52.0)], 532 * nm)
    plan = tc.plan_capture(here, scene, tolerance=0.3)
    assert (
        plan.method.model == "angular_spectrum"
        and plan.meets_tolerance
        and len(plan.distances) == 1
    )
    assert f"{plan.method.oversampling}×{plan.method.oversampling} samples a pixel" in str(plan)
    found = jax.jit(lambda c: tc.capture(c, scene, model=plan))(here)
    np.testing.assert_allclose(found, tc.capture(here, scene, model=plan), rtol=1e-6)
    finest = tc.PsfMethod("angular_spectrum", "float64", True, 27, (36, 40))
    best = replace(plan, distances=(50.0, 52.0), mixing=np.eye(2), method=finest)
    assert relative_l2(found, tc.capture(here, scene, model=best)) < plan.predicted_error
