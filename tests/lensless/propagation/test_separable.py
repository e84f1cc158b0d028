"""The exact PSF of the square aperture, against evaluations that share nothing with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless.method import PIXEL_NODES, average_error, pixel_nodes

INF = float("inf")
THESIS = {"beta": 25.0, "width": 5.632, "distance": 6.5, "wavelength": 500e-6}
SMALL = {"beta": 200.0, "width": 0.5, "distance": 20.0, "wavelength": 500e-6}
PITCH = 5.5e-3


def camera_of(shape, pitch, geometry, **mask):
    aperture = tc.FresnelZoneAperture(geometry["beta"], width=geometry["width"], **mask)
    return tc.LenslessCamera(aperture, tc.Sensor(shape, pitch), geometry["distance"])


def psf_of(shape, pitch, geometry, object_distance=INF, pixel_integration=False, **mask):
    return np.asarray(
        tc.psf(
            camera_of(shape, pitch, geometry, **mask),
            wavelength=geometry["wavelength"],
            object_distance=object_distance,
            pixel_integration=pixel_integration,
        )
    )


def coordinates(shape, pitch):
    return [reference.centred(n, pitch) for n in shape]


@pytest.mark.parametrize(
    ("shape", "pitch", "object_distance", "phase", "centre"),
    [
        # The thesis' sensor, edges included.
        pytest.param((1000, 1024), PITCH, 250.0, 0.0, (0.0, 0.0), marks=pytest.mark.thorough),
        # A coarse one that sees all round the shadow.
        ((96, 128), 0.065, 250.0, 0.7, (0.31, -0.52)),
        pytest.param((96, 128), 0.065, INF, -2.0, (-0.2, 0.1), marks=pytest.mark.thorough),
    ],
)
def test_against_scipy(shape, pitch, object_distance, phase, centre):
    """Relative L2 within 1e-12; measured 2e-13."""
    value = psf_of(shape, pitch, THESIS, object_distance, phase=phase, centre=centre)
    expected = reference.psf(
        *coordinates(shape, pitch),
        phase=phase,
        centre=centre,
        object_distance=object_distance,
        **THESIS,
    )
    assert relative_l2(value, expected) < 1e-12


@pytest.mark.thorough
def test_rectangle_against_scipy():
    """The product of the two axes is exact for it too, with the derivative along both sides."""
    small = {**SMALL, "object_distance": 300.0, "centre": (0.05, -0.1)}
    small |= {"height": 0.3, "phase": 0.7}
    sides = jnp.asarray([small.pop("height"), small.pop("width")])

    def value(sides, pixel_integration=False):
        mask = tc.FresnelZoneAperture(
            small["beta"], 0.7, width=sides[1], height=sides[0], centre=small["centre"]
        )
        camera = tc.LenslessCamera(mask, tc.Sensor((21, 34), 0.03), small["distance"])
        return tc.psf(
            camera,
            wavelength=small["wavelength"],
            object_distance=300.0,
            pixel_integration=pixel_integration,
        )

    def expected(sides):
        return reference.psf(*coordinates((21, 34), 0.03), **small, height=sides[0], width=sides[1])

    assert relative_l2(value(sides), expected(sides)) < 1e-12
    slopes = jax.jacfwd(value)(sides)
    for side in (0, 1):
        step = 1e-6 * np.eye(2)[side]
        found = (expected(sides + step) - expected(sides - step)) / 2e-6
        assert relative_l2(slopes[..., side], found) < 1e-7
    # The mean of a pixel is that of the points in it.
    fine = reference.psf(*coordinates((21 * 9, 34 * 9), 0.03 / 9), **small, height=0.3, width=0.5)
    average = fine.reshape(21, 9, 34, 9).mean(axis=(1, 3))
    assert relative_l2(value(sides, True), average) < 5e-3


def test_display_pixels():
    """A display 12 pixels wide, 70 % filled: the double sum over its slits, without zone orders."""
    geometry = {"beta": 150.0, "width": 0.36, "distance": 8.0, "wavelength": 633e-6}
    t, phase, centre, fill = 90.0, 0.4, (0.013, -0.05), 0.7
    value = psf_of(
        (20, 27), 0.03, geometry, t, phase=phase, centre=centre, pixel_pitch=0.03, fill_factor=fill
    )
    b, s = np.pi / (633e-6 * 8.0), np.pi / (633e-6 * t)
    sites, half = reference.centred(12, 0.03), 0.03 * np.sqrt(fill) / 2

    def slits(x, offset):
        ends = sites + offset
        return reference.chirp(s, b, x[:, None], ends - half, ends + half)

    shown = 0.5 * (1 + np.cos(150.0 * (sites[:, None] ** 2 + sites**2) + phase))
    y, x = coordinates((20, 27), 0.03)
    field = slits(y, centre[0]) @ shown @ slits(x, centre[1]).T * b / np.pi * (1 + 8.0 / t)
    assert relative_l2(value, np.abs(field) ** 2) < 1e-12


@pytest.mark.parametrize(
    ("geometry", "pitch", "centre", "tolerance"),
    [
        pytest.param(SMALL, 0.03, (0.04, -0.1), 1e-8, marks=pytest.mark.thorough),
        (
            {"beta": 25.0, "width": 2.0, "distance": 6.5, "wavelength": 500e-6},
            PITCH,
            (0.9, 0.2),
            1e-10,
        ),
    ],
)
def test_pixel_average(geometry, pitch, centre, tolerance):
    """Against 40×40 Gauss-Legendre points a pixel of the two-dimensional PSF.

    Fringes of the far edge turn x/(λd)·pitch = 3 times a pixel in the second set-up, which 24 nodes
    follow and 8 would not (2e-5).
    """
    shape = (16, 21)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    y, x = ((c[:, None] + nodes * pitch / 2).ravel() for c in coordinates(shape, pitch))
    fine = reference.psf(y, x, phase=0.3, centre=centre, object_distance=80.0, **geometry)
    fine = fine.reshape(16, 40, 21, 40)
    expected = np.einsum("iajb,a,b->ij", fine, weights / 2, weights / 2)
    value = psf_of(shape, pitch, geometry, 80.0, True, phase=0.3, centre=centre)
    assert relative_l2(value, expected) < tolerance
    point_sampled = psf_of(shape, pitch, geometry, 80.0, phase=0.3, centre=centre)
    assert relative_l2(point_sampled, expected) > 20 * tolerance


def test_pixel_nodes_follow_the_fringes_in_a_pixel():
    """2.4 fringes of 1.4 mm, 9.5 of 5.6 mm; known inside jit unless they are traced."""
    found = []

    def look(camera, distance):
        path = tc.LenslessCamera(camera.mask, camera.sensor, distance).path(500e-6, 250.0)
        found.append(pixel_nodes(camera.mask, camera.sensor.grid, path, "float32"))
        return distance

    small = camera_of((256, 200), PITCH, THESIS | {"width": 1.408})
    look(small, 6.5)
    jax.jit(lambda t: look(small, 6.5) * t)(1.0)
    jax.jit(lambda distance: look(small, distance))(6.5)
    look(camera_of((256, 200), PITCH, THESIS), 6.5)
    assert found == [10, 10, PIXEL_NODES, PIXEL_NODES]


def test_more_nodes_follow_more_fringes_or_leave_a_tolerance():
    """10.9, 17.6, 44.7 and 12,000 fringes a pixel; nodes that do not follow them are told of."""
    found = []
    for width, pitch, distance in (
        (0.5, 25, 2.3),
        (0.5, 40.5, 2.3),
        (0.5, 102.8, 2.3),
        (1, 300, 0.05),
    ):
        camera = camera_of(
            (9, 12), pitch * 1e-3, {"beta": 160.0, "width": width, "distance": distance}
        )
        given = camera.mask, camera.sensor.grid, camera.path(500e-6, 40.0)
        nodes = pixel_nodes(*given, "float32")
        found.append(nodes)
        few = pixel_nodes(*given, "float32", 0.01)
        assert few <= nodes and average_error(*given, few) <= 0.01
        assert (average_error(*given, nodes) == 0) == (nodes < 320)
        assert average_error(*given, 12) > average_error(*given, 20) > 0
    assert found == [32, 48, 96, 320]
