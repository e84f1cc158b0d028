"""The system's matrix against a sum over rays, and images that come back from its captures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import hologram

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.refractive_index import bk7
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.rays import pixel_centres

SENSOR = tc.Sensor((22, 30), 70.4 * um)


def small(**places):
    return wg.SeeThroughCamera(wg.Screen(hologram(), 5.0, 1.5, **places), SENSOR, 6.0, 10.0)


def plane(shape=(12, 16)):
    return wg.ObjectPlane(shape, 550.0, 120.0, (27.0, 0.0))


@pytest.mark.parametrize("shape", [(12, 16), pytest.param((40, 37), marks=pytest.mark.thorough)])
def test_every_pixel_is_the_sum_of_its_ghosts(shape):
    """Cells larger and smaller than what a pixel sees: sampled finely in place of overlaps."""
    sts, seen = small(bottom=wg.Rectangle((20.0, 0.0), (40.0, 60.0))), plane(shape)
    image = np.random.default_rng(1).uniform(size=shape)
    found = np.asarray(wg.system_operator(sts, seen, orders=3)(jnp.asarray(image)))
    rays = wg.trace(sts, pixel_centres(sts), object_distance=550.0, orders=3)
    weight = np.asarray(rays.weight)
    size = 70.4e-3 * 560 / 6
    pitch = 120.0 / shape[1]
    offsets = (np.arange(400) + 0.5) / 400 * size - size / 2
    expected = np.zeros((22, 30))
    for order, row, column in np.ndindex(weight.shape):
        x, y = np.asarray(rays.points[order, row, column, :2])
        columns = np.floor((x + offsets) / pitch + shape[1] / 2).astype(int)
        rows = np.floor((y - 27.0 + offsets) / pitch + shape[0] / 2).astype(int)
        down, across = (
            np.bincount(i[(i >= 0) & (i < n)], minlength=n)
            for i, n in ((rows, shape[0]), (columns, shape[1]))
        )
        seen_here = down @ image @ across / 400**2
        expected[row, column] += weight[order, row, column] * seen_here
    expected /= weight.sum(axis=0).mean()
    np.testing.assert_allclose(found, expected, atol=6e-3)


def test_adjoint_and_level():
    """A uniform object that fills the field gives captures about its radiance."""
    wide = wg.ObjectPlane((9, 11), 550.0, 800.0, (27.0, 0.0))
    operator = wg.system_operator(small(), wide)
    assert adjoint_error(operator, jax.random.key(1)) < 1e-14
    assert float(jnp.mean(operator(jnp.ones((9, 11))))) == pytest.approx(1, abs=1e-12)


COLOURS = ((630 * nm, 60 * deg), (532 * nm, 61.2 * deg), (460 * nm, 62.5 * deg))


def in_colours(sensor=SENSOR, width=5.0):
    """The plate of BK7 with a hologram of each colour and its angle, in films shrunk by 3 %."""
    glass = bk7()
    made = {"index": glass, "thickness": 16 * um, "index_modulation": 0.01}
    films = [wg.VolumeHologram.record(c, 0.0, a, **made).processed(0.03) for c, a in COLOURS]
    return [wg.SeeThroughCamera(wg.Screen(f, width, glass), sensor, 6.0, 10.0) for f in films]


@pytest.mark.thorough
def test_every_colour_has_the_ghosts_of_its_wavelength():
    """Of the sensor's middle in thick glass: 2wp/√(n² − p²), p = λ|K_y|/2π, by the Bragg λ."""
    sensor = tc.Sensor((1, 1), 5 * um)
    fine = wg.ObjectPlane((4096, 7), 550.0, 0.21, (75.0, 0.0))
    operator = wg.system_operator(in_colours(sensor, 20.0), fine, orders=2)
    assert operator.in_shape == (3, 1, 4096, 7) and operator.out_shape == (3, 1, 1)
    lit = np.asarray(operator.adjoint(jnp.ones((3, 1, 1))))[:, 0].sum(axis=-1)
    y = (np.arange(4096) - 2047.5) * 0.03 + 75
    steps = []
    for (colour, angle), row in zip(COLOURS, lit, strict=True):
        recorded = 2 * np.pi * float(bk7()(jnp.asarray(colour))) / colour
        down, along = recorded * np.sin(angle), recorded * (1 + np.cos(angle)) / 0.97
        wavelength = colour
        for _ in range(50):  # a contraction: the index changes little
            index = float(bk7()(jnp.asarray(wavelength)))
            wavelength = 4 * np.pi * index * along / (down**2 + along**2)
        guided = wavelength * down / (2 * np.pi)
        steps.append(2 * 20 * guided / np.sqrt(index**2 - guided**2))
        image = y < steps[-1]  # at half a step and a bit, the ghost a step further
        places = [np.average(y[part], weights=row[part]) for part in (image, ~image)]
        assert np.diff(places)[0] == pytest.approx(steps[-1], abs=1e-3)
    assert np.diff(steps).min() > 2


def test_planes_add_up():
    """A scene of two planes: the sum of both captures."""
    near = wg.ObjectPlane((12, 16), 300.0, 100.0, (27.0, 10.0))
    images = jnp.asarray(np.random.default_rng(2).uniform(size=(2, 12, 16)))
    both = wg.system_operator(small(), [plane(), near], orders=2)(images)
    each = [
        wg.system_operator(small(), p, orders=2)(i)
        for p, i in zip((plane(), near), images, strict=True)
    ]
    np.testing.assert_allclose(both, sum(each), atol=1e-14)
    with pytest.raises(ValueError, match=r"planes have \[\(12, 16\), \(9, 8\)\] cells; give"):
        wg.system_operator(small(), [plane(), plane((9, 8))])


def test_cells_that_are_too_small_are_refused():
    fine = wg.ObjectPlane((500, 500), 550.0, 20.0, (27.0, 0.0))
    with pytest.raises(ValueError, match="a pixel sees 164.* cells.*give cells of at least"):
        wg.system_operator(small(), fine)
