"""`separable` of masks of many terms: the field first, its square then."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.lensless.method import LATTICE_POINTS, AccuracyWarning
from thincam_jax.lensless.propagation.separable import (
    SeparableSum,
    lattice,
    separable,
    separable_image,
)
from thincam_jax.units import nm, um

SENSOR = tc.Sensor((14, 19), 11 * um)
RANDOM = np.random.default_rng(0)
MASKS = {
    "tall, with gaps": tc.SampledMask(
        RANDOM.normal(size=(8, 5)) + 0.3j, 20 * um, fill_factor=0.5, centre=(0.02, 0)
    ),
    "wide": tc.SampledMask(RANDOM.uniform(0, 1, (5, 8)), 20 * um, centre=(0.01, -0.02)),
    "zone plate": tc.FresnelZoneAperture(beta=25.0, phase=0.4, width=0.3),
}


@jax.jit
def of_all_pairs(mask, grid, path):
    return separable(mask, grid, path, pixel_integration=False).image()


def camera_of(mask):
    return tc.LenslessCamera(mask, SENSOR, 3.0)


def parts_of(mask):
    camera = camera_of(mask)
    return mask, camera.sensor.grid, camera.path(500 * nm, 40.0)


@pytest.mark.parametrize("mask", quick(MASKS.values(), 0), ids=MASKS)
def test_the_products_of_all_pairs_add_up_to_it(mask):
    given = parts_of(mask)
    image = jax.jit(separable_image, static_argnames="nodes")(*given, nodes=None)
    assert relative_l2(image, of_all_pairs(*given)) < 1e-13


@pytest.mark.parametrize("count", [1, 2, 21, 55, 100])
def test_lattice(count):
    """Each coordinate takes all midpoints; points turned by 180° are points."""
    points = lattice(count)
    midpoints = (np.arange(count) + 0.5) / count - 0.5
    for axis in (0, 1):
        np.testing.assert_allclose(np.sort(points[:, axis]), midpoints, atol=1e-12)
    np.testing.assert_allclose(points[::-1], -points, atol=1e-12)


@pytest.mark.thorough
def test_masks_of_many_terms_take_it():
    """With a word on its accuracy once; a number of points that is given says it is known."""
    camera = camera_of(tc.SampledMask(RANDOM.integers(0, 2, (130, 141)), 5 * um))
    how: dict[str, Any] = {
        "wavelength": 500 * nm,
        "object_distance": 40.0,
        "pixel_integration": True,
    }
    with pytest.warns(AccuracyWarning, match="130 terms .* 21 points .* nodes=144"):
        quick = tc.psf(camera, **how)
    same = tc.psf(camera, model=tc.PsfMethod("separable", nodes=LATTICE_POINTS), **how)
    np.testing.assert_array_equal(quick, same)
    better = tc.psf(camera, model=tc.PsfMethod("separable", nodes=144), **how)
    assert 1e-3 < relative_l2(quick, better) < 0.04
    how["pixel_integration"] = False
    centres = tc.psf(camera, **how)
    given = camera.mask, camera.sensor.grid, camera.path(500 * nm, 40.0)
    assert relative_l2(centres, of_all_pairs(*given)) < 1e-12
    single = tc.PsfMethod("separable", "float32")
    rounded = tc.psf(camera, model=single, **how)
    assert relative_l2(rounded, centres) < 1e-4


@pytest.mark.parametrize("average", quick((False, True), 0))
def test_predicted_error_is_above_the_true_one(average):
    camera = camera_of(tc.SampledMask(RANDOM.integers(0, 2, (131, 140)), 10 * um))
    how: dict[str, Any] = {"wavelength": 500 * nm, "object_distance": 40.0}
    how["pixel_integration"] = average
    chosen = tc.choose_model(camera, tolerance=0.01, **how)
    assert chosen.meets_tolerance and chosen.method.model == "separable"
    exact = tc.psf(camera, model=tc.PsfMethod("separable", nodes=610 if average else None), **how)
    error = relative_l2(tc.psf(camera, model=chosen.method, **how), exact)
    assert error <= chosen.predicted_error <= 0.01
    assert "131 terms" in chosen.reasons[0]


@pytest.mark.parametrize("shape", [(6, 9), (7, 4), (1, 1), (1, 6), (5, 1)])
def test_image_and_transform(shape):
    """Re ΣYX, and Σ h e^{−2πj(ux+vy)} pitch² at the grid's own coordinates and frequencies."""
    rng = np.random.default_rng(3)
    rows, columns = (rng.normal(size=(2, 3, n)) @ np.eye(n) for n in shape)
    rows, columns = rows[0] + 1j * rows[1], columns[0] + 1j * columns[1]
    grid = tc.Grid(shape, 0.3)
    terms = SeparableSum(jnp.asarray(rows), jnp.asarray(columns), grid)
    value, transform = jax.jit(lambda t: (t.image(), t.transform()))(terms)
    image = sum(np.outer(y, x).real for y, x in zip(rows, columns, strict=True))
    np.testing.assert_allclose(value, image, rtol=0, atol=1e-13)
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.3 for n in shape)
    v, u = (np.fft.fftshift(np.fft.fftfreq(n, 0.3)) for n in shape)
    expected = np.exp(-2j * np.pi * np.outer(v, y)) @ image @ np.exp(-2j * np.pi * np.outer(x, u))
    np.testing.assert_allclose(transform, expected * 0.09, rtol=0, atol=1e-13)
