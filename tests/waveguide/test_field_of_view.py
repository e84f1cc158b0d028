"""The field of view against light that is followed forwards, from the object to the sensor."""

import numpy as np
import pytest
from scipy.optimize import brentq
from waveguide import setting

import thincam_jax as tc
from helpers import quick
from thincam_jax import waveguide as wg
from thincam_jax.units import deg, um
from thincam_jax.waveguide.field_of_view import FieldOfView, field_of_view

# Of section 5.3.1, in the places of the shipped files; (y, x), mm.
TOP, BOTTOM = ((0.0, 0.0), (20.0, 50.0)), ((25.0, 0.0), (50.0, 50.0))


def thesis_camera(shape=(1024, 1280), distance=10.0, glass=5.0, bottom=BOTTOM, angle=61.2):
    film = wg.VolumeHologram.record(
        setting.RECORDED, 0.0, angle * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    screen = wg.Screen(film, glass, 1.5, wg.Rectangle(*TOP), wg.Rectangle(*bottom))
    return wg.SeeThroughCamera(screen, tc.Sensor(shape, 4.8 * um), 6.0, distance)


def arrives(slope, camera, orders, angle):
    """Whether light of slopes (x, y) that goes through the pinhole reaches the sensor.

    It is followed from surface to surface, by Snell's law in vectors and mirrors at the fringes.
    The whole is invariant to shifts, so that it starts at (0, 0) and is moved onto the pinhole.
    """
    distance, width = float(camera.lens_distance), float(camera.screen.glass_thickness)
    top, bottom = edges(camera.screen.top), edges(camera.screen.bottom)
    sides = np.array(camera.sensor.shape[::-1]) * float(camera.sensor.pitch) / 2
    if (abs(slope) * float(camera.focal_distance) > sides).any():
        return False
    outside = -np.array([*slope, 1.0]) / np.hypot(1, np.linalg.norm(slope))
    inside = np.array([*outside[:2] / 1.5, 0.0])
    inside[2] = -np.sqrt(1 - inside[:2] @ inside[:2])
    fringes = np.array([0.0, -np.sin(angle), 1 + np.cos(angle)])
    fringes /= np.linalg.norm(fringes)
    light = inside - 2 * (inside @ fringes) * fringes
    if light[2] <= 0 or np.hypot(*light[:2]) < 1 / 1.5:
        return False
    place = np.zeros(2)  # on the rear surface, at the bottom hologram
    for _ in range(orders):
        place = place + width * light[:2] / light[2]
        leaving = place + width * inside[:2] / -inside[2] + distance * outside[:2] / -outside[2]
        if holds(top, place - leaving) and holds(bottom, -leaving):
            return True
        place = place + width * light[:2] / light[2]  # reflected at the front and the rear
    return False


def edges(rectangle):
    centre, half = np.asarray(rectangle.centre), np.asarray(rectangle.size) / 2
    return (centre - half)[::-1], (centre + half)[::-1]


def holds(limits, place):
    return (place >= limits[0]).all() and (place <= limits[1]).all()


@pytest.mark.parametrize(
    ("camera", "angle", "orders"),
    quick(
        [
            (thesis_camera(), 61.2, 1),
            (thesis_camera(distance=23.3), 61.2, 1),
            (thesis_camera(distance=23.3), 61.2, 3),
            (thesis_camera(shape=(440, 300)), 61.2, 1),
            (thesis_camera(bottom=((25.0, 1.0), (50.0, 12.0))), 61.2, 1),
            (thesis_camera(angle=48.0), 48.0, 2),  # ended by the critical angle
        ],
        *(2, 4, 5),
    ),
)
def test_field_ends_with_the_light_that_reaches_the_sensor(camera, angle, orders):
    angles = np.arange(-28, 28, 0.05)
    found = []
    for axis in (np.array([0.0, 1.0]), np.array([1.0, 0.0])):
        seen = [arrives(tan * axis, camera, orders, angle * deg) for tan in np.tan(angles * deg)]
        found.append(np.ptp(angles[seen]))
    field = field_of_view(camera, orders=orders)
    assert (field.vertical_deg, field.horizontal_deg) == pytest.approx(found, abs=0.1)
    assert all(value > 5 for value in found)


def distance_for(vertical, orders=1, **changes):
    """d1, mm, at which the field of view along y is so many degrees."""

    def excess(distance):
        camera = thesis_camera(distance=distance, **changes)
        return field_of_view(camera, orders=orders).vertical_deg - vertical

    return brentq(excess, 10.0, 60.0, xtol=0.01)


@pytest.mark.parametrize(
    ("distance", "changes"),
    quick(
        [
            (23.3, {}),
            (29.2, {"orders": 4}),
            (11.2, {"glass": 2.0}),
            (26.5, {"glass": 8.0}),
            (26.9, {"bottom": ((22.5, 0.0), (50.0, 50.0))}),
            (16.4, {"bottom": ((27.5, 0.0), (50.0, 50.0))}),
        ],
        *(1, 4),
    ),
)
def test_lens_distance_that_the_published_field_of_view_means(distance, changes):
    """Of the image's vertical 34.3°: the figures of `docs/measured/screen.md`."""
    assert distance_for(34.3, **changes) == pytest.approx(distance, abs=0.1)


def test_published_field_is_neither_the_crops_nor_horizontal():
    for distance in (5.0, 23.3):
        crop = field_of_view(thesis_camera((440, 440), distance))
        assert crop.vertical_deg == crop.horizontal_deg == pytest.approx(19.97, abs=0.02)
    assert field_of_view(thesis_camera(distance=23.3)).horizontal_deg > 54


def test_a_plate_that_guides_nothing_has_no_field():
    assert field_of_view(thesis_camera((44, 44), angle=35.0)) == FieldOfView(0.0, 0.0)
