"""Masks on a display: against quadrature over the open parts and a zone plate's own pixels."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, quick, value_and_slope
from thincam_jax.lensless.masks.display import on_display
from thincam_jax.lensless.masks.phase import MaskBlank
from thincam_jax.units import nm, um

WAVELENGTH, DISTANCE, PITCH, FILL = 550 * nm, 2.0, 0.03, 0.64
SENSOR = tc.Sensor((14, 19), 0.031)
CENTRE = (0.02, -0.05)
SPREAD = 1 + DISTANCE / 150.0
LIGHT = {"wavelength": WAVELENGTH, "object_distance": 150.0}


def psf(mask, **options):
    return tc.psf(
        tc.LenslessCamera(mask, SENSOR, DISTANCE),
        **LIGHT,
        **{"pixel_integration": False, **options},
    )


def quadrature(cells):
    """|U|² behind pixels whose middle √FILL is open, by Gauss-Legendre nodes in each.

    Relative to the light on the sensor without a mask.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    half = PITCH * np.sqrt(FILL) / 2

    def along(axis):
        count, seen = cells.shape[axis], SENSOR.shape[axis]
        x = (np.arange(seen) - (seen - 1) / 2) * 0.031
        xi = CENTRE[axis] + ((np.arange(count) - (count - 1) / 2) * PITCH)[:, None] + half * nodes
        turns = (x[:, None, None] - xi) ** 2 / (2 * WAVELENGTH * DISTANCE)
        turns = turns + xi**2 / (2 * WAVELENGTH * 150.0)
        return (np.exp(2j * np.pi * turns) * weights * half).sum(-1)

    field = along(0) @ cells @ along(1).T / (WAVELENGTH * DISTANCE)
    return np.abs(field * SPREAD) ** 2


def test_codes_against_quadrature_over_the_open_parts():
    mask = tc.ModifiedUniformlyRedundantArray(5, 0.06, tiles=(1, 2), centre=CENTRE)
    shown = on_display(mask, PITCH, FILL)
    cells = np.kron(np.asarray(mask.cells), np.ones((2, 2)))
    np.testing.assert_allclose(psf(shown), quadrature(cells), rtol=1e-9, atol=1e-11)
    whole = on_display(mask, PITCH)
    np.testing.assert_allclose(psf(whole), psf(mask), rtol=1e-9, atol=1e-11)


def test_many_cells_are_a_sampled_mask_with_gaps():
    """Of no few terms; `separable` is exact for it, too."""
    mask = tc.SampledMask(np.random.default_rng(1).uniform(0, 1, (6, 8)), PITCH, centre=CENTRE)
    shown = on_display(mask, PITCH, FILL)
    assert isinstance(shown, tc.SampledMask)
    expected = quadrature(np.asarray(mask.amplitude))
    np.testing.assert_allclose(psf(shown), expected, rtol=1e-9, atol=1e-11)
    shadow = psf(shown, model="geometric", pixel_integration=True)
    light = FILL * np.sum(np.asarray(mask.amplitude) ** 2) * (PITCH * SPREAD) ** 2
    assert float(shadow.sum()) * 0.031**2 == pytest.approx(light, rel=1e-9)


def relief(fill):
    heights = np.random.default_rng(2).uniform(0, 1e-3, (20, 30))
    smooth = MaskBlank((20, 30), 0.06, 1.5).mask(heights, "bilinear")
    return on_display(smooth, PITCH, fill)


@pytest.mark.parametrize(
    "shown",
    quick([lambda fill: on_display(tc.RadialMask([1.0, 0.3, 0.8], 0.2), PITCH, fill), relief], 1),
    ids=["rings", "relief"],
)
def test_gaps_take_their_part_of_the_light(shown):
    grid = SENSOR.grid.with_shape((240, 360))
    grid = type(grid)(grid.shape, jnp.asarray(PITCH / 6))
    sample = jax.jit(lambda mask: mask.sample(grid, WAVELENGTH))
    whole, gaps = (np.asarray(sample(shown(fill))) for fill in (1.0, FILL))
    # Rows of six samples: 0.8 of a pixel is open, so that the outermost are open in part.
    middle = np.kron(np.ones((40, 60)), np.outer(*[[0.4, 1, 1, 1, 1, 0.4]] * 2))
    np.testing.assert_allclose(gaps, whole * middle, atol=1e-12)


def test_heights_of_a_display_are_the_reliefs_at_its_pixels():
    heights = np.random.default_rng(3).uniform(0, 1e-3, (10, 14))
    cells = tc.PhaseMask(heights, 0.06, 1.5, amplitude=heights * 900)
    shown = on_display(cells, PITCH, 0.9)
    np.testing.assert_allclose(shown.height, np.kron(heights, np.ones((2, 2))), rtol=1e-9)
    np.testing.assert_allclose(shown.amplitude, np.kron(heights * 900, np.ones((2, 2))), rtol=1e-9)
    assert not shown.pure_phase and float(shown.fill_factor) == 0.9


def test_gradients_and_vmap():
    shown = on_display(tc.FresnelZoneAperture(25.0, 0.3, width=1.2), PITCH, FILL)

    def total(numbers):
        where = lambda m: (m.pixel_pitch, m.fill_factor, m.mask.beta)  # noqa: E731
        return jnp.sum(jnp.sin(30 * psf(eqx.tree_at(where, shown, tuple(numbers)))))

    value, slope_of = value_and_slope(total)
    numbers, direction = jnp.asarray([PITCH, FILL, 25.0]), jnp.asarray([0.01, 1.0, 3.0])
    slope = slope_of(numbers) @ direction
    known = finite_difference(value, numbers, direction, 3e-6)
    np.testing.assert_allclose(slope, known, rtol=1e-6)
    several = jnp.stack([numbers, numbers * 1.01])
    some = jax.jit(jax.vmap(total))(several)
    np.testing.assert_allclose(some, [value(each) for each in several], rtol=1e-9)


def test_refuses():
    mask = tc.ModifiedUniformlyRedundantArray(5, 0.06)
    with pytest.raises(ValueError, match="height = 0.3 mm is not a whole number of cells of pixel"):
        on_display(mask, 0.07)
    with pytest.raises(ValueError, match="fill_factor"):
        on_display(mask, PITCH, 1.2)
    with pytest.raises(TypeError, match="on_display needs a mask of known size"):
        jax.jit(lambda c: on_display(tc.RadialMask([1.0], c), PITCH).centre)(0.3)
    with pytest.raises(ValueError, match="have no gaps"):
        tc.PhaseMask(np.zeros((4, 4)), 5 * um, 1.5, interpolation="bilinear", fill_factor=0.5)
