"""Rings: against quadrature, closed forms, `angular_spectrum` and finite differences."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0

import thincam_jax as tc
from helpers import finite_difference, relative_l2, value_and_slope
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.method import LATTICE_POINTS
from thincam_jax.lensless.propagation.radial import (
    PROFILE_ERROR,
    irradiance,
    profile_samples,
    radial,
)
from thincam_jax.units import nm, um

WAVELENGTH = 550 * nm
CODE = np.random.default_rng(0).integers(0, 2, 24) * 1.0


def camera_of(
    rings: Any = CODE,
    ring: Any = 0.75 / 24,
    shape=(64, 75),
    pitch=22 * um,
    distance=2.0,
    centre=None,
):
    mask = tc.RadialMask(rings, ring, centre=(0.01, -0.02) if centre is None else centre)
    return tc.LenslessCamera(mask, tc.Sensor(shape, pitch), distance)


def psf(camera, object_distance=250.0, **how):
    how = {"model": "radial", "object_distance": object_distance} | how
    how.setdefault("pixel_integration", isinstance(how["model"], tc.PsfMethod))
    return tc.psf(camera, wavelength=WAVELENGTH, **how)


def by_quadrature(camera, object_distance):
    """|Σ t w e^{jπ r²/(λt)} e^{jπ |x − r|²/(λd)}|² M²/(λd)² over points of the mask's area."""
    mask, distance = camera.mask, float(camera.distance)
    radii = np.concatenate([[0], np.asarray(mask.radii)])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    r = (radii[:-1, None] + np.diff(radii)[:, None] * (nodes + 1) / 2).ravel()
    w = (np.asarray(mask.rings)[:, None] * np.diff(radii)[:, None] * weights / 2).ravel() * r
    angle = 2 * np.pi * np.arange(300) / 300
    down, across = (
        (np.outer(r, f(angle)) + float(c)).ravel()
        for f, c in zip((np.sin, np.cos), mask.centre, strict=True)
    )
    w = np.repeat(w * 2 * np.pi / 300, 300)
    lit = w * np.exp(1j * np.pi / WAVELENGTH / object_distance * (down**2 + across**2))
    b = np.pi / WAVELENGTH / distance
    rows, columns = (np.asarray(part) for part in (camera.sensor.grid.y, camera.sensor.grid.x))
    field = [
        [np.sum(lit * np.exp(1j * b * ((y - down) ** 2 + (x - across) ** 2))) for x in columns]
        for y in rows
    ]
    return np.abs(field) ** 2 * ((1 + distance / object_distance) / WAVELENGTH / distance) ** 2


@pytest.mark.parametrize("ring", [0.03, [0.05, 0.02, 0.03]], ids=["equal", "unequal"])
def test_quadrature_over_the_area_of_the_mask(ring):
    """Off the axis, from a near point, on pixels inside and outside of the shadow."""
    camera = camera_of([1.0, 0.0, 0.6], ring, (5, 8), 36 * um, 1.5, (0.004, -0.007))
    expected = by_quadrature(camera, 10.0)
    np.testing.assert_allclose(psf(camera, 10.0), expected, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(psf(camera, 10.0, model="separable"), psf(camera, 10.0))
    if ring != 0.03:
        single = tc.PsfMethod("radial", "float32", False)
        np.testing.assert_allclose(psf(camera, 10.0, model=single), expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("zones", [1e-4, 0.7, 3.0, 50.0, 4000.0])
def test_disc_on_the_axis_and_at_its_rim(zones):
    """4 sin²(u/4) and ¼(1 − 2 cos(u) J₀(u) + J₀²(u)), u = 2πa²/(λd) (Lommel)."""
    a, path = 0.1, LightPath(WAVELENGTH, 0.1**2 / WAVELENGTH / zones)
    u = 2 * np.pi * zones
    found = irradiance(tc.RadialMask([1.0], a), path, jnp.asarray([0.0, a]))
    rim = (1 - 2 * np.cos(u) * j0(u) + j0(u) ** 2) / 4
    np.testing.assert_allclose(found, [4 * np.sin(u / 4) ** 2, rim], rtol=1e-6, atol=2e-9)


def test_a_round_zone_plate_focuses():
    """Ten open zones send (2·10)² to the focus: rings between the radii √(nλf)."""
    radii = np.sqrt(np.arange(21) * WAVELENGTH * 4.0)
    camera = camera_of((np.arange(20) + 1.0) % 2, np.diff(radii), (1, 1), 1e-3, 4.0, (0.0, 0.0))
    assert float(psf(camera, np.inf)[0, 0]) == pytest.approx(400, rel=1e-7)


@pytest.mark.thorough
@pytest.mark.parametrize("average", [False, True], ids=["points", "average"])
def test_the_interpolated_profile(average):
    """As the value at each point, with few fringes a pixel and with many; off the axis, too."""
    nodes = LATTICE_POINTS if average else None
    for distance, centre in ((2.0, (0.01, -0.02)), (40.0, (0.3, 1.9))):
        camera = camera_of(shape=(56, 45), distance=distance, centre=centre)
        method = tc.PsfMethod("radial", "float64", average, nodes=nodes)
        grid, path = camera.sensor.grid, camera.path(WAVELENGTH, 250.0)
        samples = profile_samples(camera.mask, grid, path, method)
        if not samples:
            assert not average
            samples = 512
        method = tc.PsfMethod("radial", "float64", average, samples, nodes=nodes)
        interpolated = psf(camera, model=method)
        method = tc.PsfMethod("radial", None, average, nodes=nodes)
        for first in (0, 20):
            # Columns at an edge and in the middle are those of a narrow sensor, the mask moved.
            x = float(jnp.mean(grid.x[first : first + 5]))
            beside = centre[0], centre[1] - x / (1 + distance / 250.0)
            narrow = camera_of(shape=(56, 5), distance=distance, centre=beside)
            exact = jax.jit(radial, static_argnums=3)(narrow.mask, narrow.sensor.grid, path, method)
            assert relative_l2(interpolated[:, first : first + 5], exact) < PROFILE_ERROR


@pytest.mark.thorough
def test_choice_meets_the_tolerance():
    """`angular_spectrum`, the only model before, is 4 to 8 % off however many samples it has."""
    camera = camera_of(shape=(56, 45), pitch=5.5 * um)
    exact = psf(camera)
    light: dict[str, Any] = {"wavelength": WAVELENGTH, "object_distance": 250.0}
    choice = tc.choose_model(camera, tolerance=1e-4, **light, pixel_integration=False)
    assert (choice.method.model, choice.meets_tolerance) == ("radial", True)
    assert "24 rings" in choice.reasons[0]
    assert relative_l2(psf(camera, model=choice.method), exact) <= choice.predicted_error < 1e-4
    sampled = psf(camera, model=tc.PsfMethod("angular_spectrum", None, False, 3))
    assert relative_l2(sampled, exact) > 0.02
    single = psf(camera, model=tc.PsfMethod("radial", "float32", False))
    assert relative_l2(single, exact) < 1e-4


def test_other_masks_and_shapes_are_refused():
    camera = tc.LenslessCamera(tc.Pinhole(0.1), tc.Sensor((3, 4), 0.1), 5.0)
    assert camera.mask.exact_model == "separable"
    with pytest.raises(TypeError, match="'radial' needs a RadialMask; for a Pinhole use 'sepa"):
        psf(camera)
    with pytest.raises(ValueError, match=r"ring has shape \(2,\); give one width, or one for ea"):
        tc.RadialMask([1.0, 0.0, 1.0], [0.1, 0.2])


@pytest.mark.thorough
def test_gradients_in_every_number():
    """d, λ, t, values and widths of rings and their place, on and off the shadow's rims."""
    weights = jnp.asarray(np.random.default_rng(1).uniform(size=(9, 12)))

    def weighted(numbers):
        mask = tc.RadialMask(numbers[3:6], numbers[6:9], centre=numbers[9:])
        camera = tc.LenslessCamera(mask, tc.Sensor((9, 12), 20 * um), 2.0 * numbers[0])
        given = {"wavelength": WAVELENGTH * numbers[1], "object_distance": 30 * numbers[2]}
        return jnp.sum(weights * tc.psf(camera, model="radial", **given, pixel_integration=False))

    start = jnp.asarray([1, 1, 1, 0.9, 0.1, 0.6, 0.05, 0.02, 0.03, 0.0, 0.01])
    value, slope = value_and_slope(weighted)
    found = slope(start)
    for i in range(len(start)):
        expected = finite_difference(value, start, jnp.zeros(len(start)).at[i].set(1.0), 1e-6)
        np.testing.assert_allclose(found[i], expected, rtol=1e-5, atol=1e-5)
