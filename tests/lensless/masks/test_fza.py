"""The Fresnel zone aperture: its profile, edges, display pixels and refusals."""

import jax
import numpy as np
import pytest
from lensless.propagation.reference import centred

import thincam_jax as tc
from thincam_jax.units import nm, um

sample = jax.jit(lambda mask, grid: mask.sample(grid))


def test_cosine_profile():
    """½[1 + cos(βr² + φ)] inside the square, 0 outside; +y down, +x right."""
    mask = tc.FresnelZoneAperture(30.0, 0.7, width=1.0, centre=(0.1, -0.2))
    value = sample(mask, tc.Grid((24, 31), 0.07))
    y, x = centred(24, 0.07)[:, None] - 0.1, centred(31, 0.07) + 0.2
    inside = (np.abs(y) + 0.035 < 0.5) & (np.abs(x) + 0.035 < 0.5)
    outside = (np.abs(y) - 0.035 > 0.5) | (np.abs(x) - 0.035 > 0.5)
    expected = 0.5 * (1 + np.cos(30.0 * (y**2 + x**2) + 0.7))
    np.testing.assert_allclose(value[inside], expected[inside], rtol=0, atol=1e-13)
    assert inside.sum() > 100 and np.all(np.asarray(value)[outside] == 0.0)


def test_cells_cut_by_the_edge_count_by_their_open_area():
    """Uniform where φ = 0 and β → 0: the samples' sum is the aperture's area exactly."""
    mask = tc.FresnelZoneAperture(1e-9, width=0.513, centre=(0.011, -0.02))
    value = np.asarray(sample(mask, tc.Grid((30, 41), 0.02)))
    np.testing.assert_allclose(value.sum() * 0.02**2, 0.513**2, rtol=1e-9)
    assert ((value > 0.01) & (value < 0.99)).sum() > 80  # one ring of partly open cells


def test_rectangle():
    """Its area is width × height; pixels fill both; the finest zones are at the farther edges."""
    sides = {"width": 0.513, "height": 0.27}
    mask = tc.FresnelZoneAperture(1e-9, **sides, centre=(0.011, -0.02))
    value = np.asarray(sample(mask, tc.Grid((30, 41), 0.02)))
    np.testing.assert_allclose(value.sum() * 0.02**2, 0.513 * 0.27, rtol=1e-9)
    tall = tc.FresnelZoneAperture(30.0, 0.7, width=0.5, height=0.8, pixel_pitch=0.1)
    assert tall.pixels == (8, 5)
    assert float(tall.finest_frequency) == pytest.approx(30.0 * 0.8 / (2 * np.pi))
    shown = np.asarray(sample(tall, tc.Grid((10, 9), 0.1)))
    y, x = centred(10, 0.1)[:, None], centred(9, 0.1)
    inside = (np.abs(y) < 0.4) & (np.abs(x) < 0.25 - 0.01)
    np.testing.assert_allclose(
        shown[inside], (0.5 * (1 + np.cos(30.0 * (y**2 + x**2) + 0.7)))[inside], atol=1e-13
    )
    assert (shown > 0).sum() <= 8 * 5
    with pytest.raises(ValueError, match=r"height = 0\.75 mm is not a whole number of cells"):
        tc.FresnelZoneAperture(30.0, width=0.5, height=0.75, pixel_pitch=0.1)


def test_binary_profile_is_its_truncated_series():
    mask = tc.FresnelZoneAperture(30.0, 0.7, width=2.0, profile="binary", harmonics=99)
    grid = tc.Grid((24, 31), 0.05)
    r2 = centred(24, 0.05)[:, None] ** 2 + centred(31, 0.05) ** 2
    cosine = np.cos(30.0 * r2 + 0.7)
    clear = np.abs(cosine) > 0.3
    np.testing.assert_allclose(sample(mask, grid)[clear], (cosine > 0)[clear], rtol=0, atol=0.03)
    orders = mask.zone_orders()
    k = np.asarray(orders.orders)
    expected = np.where(k == 0, 0.5, np.sin(k * np.pi / 2) / (np.where(k == 0, 1, k) * np.pi))
    np.testing.assert_allclose(orders.coefficients, expected * np.exp(0.7j * k), atol=1e-15)
    assert sorted(orders.orders) == [k for k in range(-99, 100) if k % 2 or k == 0]


def test_display_pixels():
    """Each pixel shows the value at its centre over the open part √fill × √fill of its cell."""
    mask = tc.FresnelZoneAperture(30.0, 0.7, width=0.6, pixel_pitch=0.1, fill_factor=0.64)
    sites = centred(6, 0.1)
    shown = 0.5 * (1 + np.cos(30.0 * (sites[:, None] ** 2 + sites**2) + 0.7))
    coarse = sample(mask, tc.Grid((6, 8), 0.1))
    np.testing.assert_allclose(coarse[:, 1:-1], shown * 0.64, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(coarse[:, ::7], 0.0)
    fine = np.asarray(sample(mask, tc.Grid((60, 60), 0.01))).reshape(6, 10, 6, 10)
    np.testing.assert_allclose(
        fine[:, 1:9, :, 1:9], np.broadcast_to(shown[:, None, :, None], (6, 8, 6, 8)), atol=1e-13
    )
    assert np.all(fine[:, [0, 9]] < 1e-12)


def test_other_numbers_keep_the_display():
    """Its pixels are of a pitch, which a copy with another β or width keeps."""
    mask = tc.FresnelZoneAperture(25.0, width=1.6, height=0.8, pixel_pitch=20 * um)
    assert mask.replace(beta=30.0).pixels == mask.pixels == (40, 80)
    assert mask.replace(width=1.2).pixels == (40, 60)
    exposure = tc.Exposures(30.0, 5.0, wavelength=500 * nm, width=1.2, profile="binary")[0]
    shown = exposure.mask(mask)
    assert (shown.pixels, shown.profile, shown.beta) == ((40, 60), "binary", 30.0)
