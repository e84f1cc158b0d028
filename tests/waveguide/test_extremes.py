"""Rays where formulas lose their digits, against 40 digits, and what is refused."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from waveguide.setting import RECORDED, camera, hologram

from helpers import ROOT
from thincam_jax import waveguide as wg
from thincam_jax.units import deg, um
from thincam_jax.waveguide.rays import RayStatus
from thincam_jax.waveguide.smear import trace_band

CRITICAL = np.degrees(np.arcsin(1 / 1.5))
PIXEL = (0.3, -0.4)


def recorded(reference, toward=0.0):
    values = {"index": 1.5, "thickness": 16 * um, "index_modulation": 0.02}
    return wg.VolumeHologram.record(RECORDED, toward, reference * deg, **values)


def weak(scale):
    film = hologram()
    return wg.VolumeHologram(film.grating * scale, 1.5, film.thickness, film.index_modulation)


def case(film=None, width=5.0, distance=550.0, pixel=PIXEL, top=None):
    sts = camera(film)
    screen = wg.Screen(sts.screen.hologram, width, 1.5, top=top)
    return wg.SeeThroughCamera(screen, sts.sensor, 6.0, 10.0), pixel, distance


# Air at 89.9° from the normal, and the object wave of the recording beside it.
GRAZING = np.arcsin(np.sin(89.9 * deg) / 1.5)
# 2 mm of hologram where that light meets it: the way from the pinhole, and through the glass.
MET = 10.0 * np.tan(89.9 * deg) + 5.0 * np.tan(GRAZING)

# name: (camera, pixel, object distance), bounds of the points in float32 and float64, status.
BESIDE, MIDDLE = (-6.0 * np.tan(89.9 * deg), 0.0), (0.0, 0.0)
OBLIQUE = (-6.0 * np.tan(np.arcsin(1.5 * np.sin(10.0 * deg))), 0.0)

EXTREMES = {
    "the default": (case(), 3e-7, 1.2e-15, 0),
    "in air at 89.9°": (
        case(recorded(60.0, GRAZING), pixel=BESIDE, top=wg.Rectangle((MET, 0.0), (2.0, 2.0))),
        3e-7,
        1.2e-15,
        0,
    ),
    "Θ′ at the critical angle + 0.001°": (
        case(recorded(CRITICAL + 1e-3), pixel=MIDDLE),
        5e-7,
        1.2e-15,
        0,
    ),
    "Θ′ at the critical angle − 0.001°": (
        case(recorded(CRITICAL - 1e-3), pixel=MIDDLE),
        5e-7,
        1.2e-15,
        3,
    ),
    "Θ′ = 89.9°": (case(recorded(89.9), pixel=MIDDLE), 3e-7, 1.2e-15, 0),
    "Θ′ = 89.9999°": (case(recorded(89.9999), pixel=MIDDLE), 4e-7, 1.2e-15, 0),
    # The rounding of four numbers in s′_z, half a unit in the last place each, over s′_z = 1/573.
    "Θ′ = 89.9°, light at 10°": (
        case(recorded(89.9, 10.0 * deg), pixel=OBLIQUE),
        1.4e-4,
        2.5e-13,
        0,
    ),
    "w = 1e-6 mm": (case(width=1e-6, pixel=MIDDLE), 3e-7, 1.2e-15, 0),
    "w = 50 mm": (case(width=50.0), 4e-7, 1.8e-15, 0),
    "d2 = 1e9 mm": (case(distance=1e9), 3e-7, 1.2e-15, 0),
    "K by 1e-6": (case(weak(1e-6)), 3e-7, 1.2e-15, 0),
    "K by 1e-15": (case(weak(1e-15)), 4e-7, 1.2e-15, 0),
}
DTYPES = {"float32": jnp.float32, "float64": jnp.float64}


def exact(sts, pixel, distance, orders=4):
    """(order, 2) points in 40 digits, from the numbers as the camera holds them."""
    with mpmath.workdps(40):

        def number(value):
            return mpmath.mpf(float(value))

        y, x = (number(p) for p in pixel)
        film = sts.screen.hologram
        fringes = mpmath.matrix([number(k) for k in film.grating])
        index, glass = number(film.index.value), number(sts.screen.glass_index.value)
        length = mpmath.sqrt(x**2 + y**2 + number(sts.focal_distance) ** 2)
        t = mpmath.matrix([-x / length, -y / length])
        squared = t[0] ** 2 + t[1] ** 2
        s = mpmath.matrix([t[0] / index, t[1] / index, mpmath.sqrt(1 - squared / index**2)])
        power = sum(k**2 for k in fringes)
        along = sum(a * b for a, b in zip(s, fringes, strict=True)) / power
        mirrored = [a - 2 * along * k for a, k in zip(s, fringes, strict=True)]
        p = [index * mirrored[0], index * mirrored[1]]
        left = glass**2 - p[0] ** 2 - p[1] ** 2
        width = number(sts.screen.glass_thickness)
        path = number(sts.lens_distance) + number(distance)
        places = [
            [
                path * t[a] / mpmath.sqrt(1 - squared)
                + (2 * i + 1) * width * p[a] / mpmath.sqrt(left)
                + 2 * width * t[a] / mpmath.sqrt(glass**2 - squared)
                for a in (0, 1)
            ]
            for i in range(orders)
        ]
        return np.array(places, float)


def error(name, dtype):
    """Largest error of the points over all orders, relative to the farthest of them."""
    given = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), EXTREMES[name][0])
    sts, pixel, distance = given
    rays = wg.trace(sts, jnp.stack(pixel), object_distance=distance, orders=4)
    expected = exact(*given)
    found = np.asarray(rays.points[..., :2], float)
    assert np.isfinite(found).all() and np.isfinite(np.asarray(rays.weight)).all()
    band = trace_band(sts, jnp.stack(pixel)[None], distance, 4, 8)
    assert all(np.isfinite(np.asarray(part)).all() for part in (band.points, band.weight))
    return np.abs(found - expected).max() / np.abs(expected).max(), set(np.asarray(rays.status))


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_points(name, dtype):
    """Finite in both precisions, with the bounds that the page states and the right status."""
    bound = EXTREMES[name][1 + list(DTYPES).index(dtype)]
    found, status = error(name, DTYPES[dtype])
    assert found < bound
    assert status == {EXTREMES[name][3]}


def test_documented():
    """The page's table has every row, and behind each measured error the bound held here."""
    page = (ROOT / "docs/measured/extremes.md").read_text(encoding="utf-8")
    table = page[page.index("| rays |") :].split("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    assert [row[0] for row in rows] == list(EXTREMES)
    for name, *cells in rows:
        for cell, bound in zip(cells[-2:], EXTREMES[name][1:3], strict=True):
            measured, quoted = (float(part) for part in cell.split(" < "))
            assert 2 * measured < bound == quoted


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_fringes(dtype):
    """K = 0 matches nothing; the points are finite and dark all the same."""
    given = jax.tree.map(lambda leaf: jnp.asarray(leaf, DTYPES[dtype]), case(weak(0.0)))
    sts, pixel, distance = given
    rays = wg.trace(sts, jnp.stack(pixel), object_distance=distance, orders=2)
    assert (rays.status == RayStatus.NO_BRAGG_MATCH).all()
    assert np.isfinite(rays.points).all() and not rays.weight.any()
    band = trace_band(sts, jnp.stack(pixel)[None], distance, 4, 8)
    assert np.isfinite(band.points).all() and not band.weight.any()


@pytest.mark.parametrize(
    ("screen", "message"),
    [
        ({"film": recorded(38.0)}, "Θ' = 38.00° in the glass, under the critical angle of 41.81°"),
        (
            {"glass": 1.2},
            r"n sin Θ' = 1.314, which a glass of n = 1.2 cannot carry; give a smaller",
        ),
        ({"film": weak(0.0)}, "diffracts no wavelength of its index's band back"),
        (
            {"bottom": wg.Rectangle((9.0, 0.0), (15.0, 20.0))},
            r"bottom.size = \(15, 20\) mm is smaller than one bounce .*, \(18.19, 0\) mm",
        ),
    ],
)
def test_screens_that_show_nothing_are_refused(screen, message):
    with pytest.raises(ValueError, match=message):
        wg.check_screen(camera(**screen))
    wg.check_screen(camera(bottom=wg.Rectangle((30.0, 0.0), (50.0, 20.0))))
