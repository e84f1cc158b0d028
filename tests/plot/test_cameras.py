"""Figures of a camera: values and axes against the functions that compute them."""

import matplotlib
import numpy as np
import pytest

import thincam_jax as tc

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def closed():
    from matplotlib import pyplot

    yield
    pyplot.close("all")


def test_a_psf_lies_on_the_sensor_in_mm():
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 30), 0.05), distance=3.0)
    figure = tc.plot.psf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    image, line = figure.axes[:2]
    assert image.images[0].get_extent() == pytest.approx([-0.75, 0.75, 0.6, -0.6])
    expected = tc.psf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    np.testing.assert_array_equal(image.images[0].get_array(), expected)
    np.testing.assert_array_equal(line.lines[0].get_ydata(), expected[12])


def test_an_otf_has_axes_in_cycles_per_mm():
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 30), 0.05), distance=3.0)
    figure = tc.plot.otf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    image, line = figure.axes[:2]
    expected = np.asarray(
        tc.otf(camera, wavelength=5e-4, model="geometric", pixel_integration=False)
    )
    expected = expected / abs(expected[12, 15])
    u, v = np.asarray(camera.sensor.grid.u), np.asarray(camera.sensor.grid.v)
    levels = 20 * np.log10(np.maximum(abs(expected), 1e-6))
    np.testing.assert_allclose(image.images[0].get_array(), levels, atol=1e-9)
    along = np.stack([u[15:], levels[12, 15:]], axis=1)
    np.testing.assert_allclose(line.lines[0].get_xydata(), along, atol=1e-9)
    left, right, bottom, top = image.images[0].get_extent()
    assert (left, right) == pytest.approx((u[0] - (u[1] - u[0]) / 2, u[-1] + (u[1] - u[0]) / 2))
    assert (bottom, top) == pytest.approx((v[-1] + (v[1] - v[0]) / 2, v[0] - (v[1] - v[0]) / 2))


def test_a_mask_lies_in_mm_and_shows_a_phase_where_it_has_one():
    pinhole = tc.Pinhole(0.4, 0.2)
    figure = tc.plot.mask(pinhole, samples=40)
    assert figure.axes[0].images[0].get_extent() == pytest.approx([-0.2, 0.2, 0.1, -0.1])
    assert figure.axes[0].images[0].get_array().shape == (20, 40)
    assert len(figure.axes) == 2  # with the bar of grey levels
    heights = np.linspace(0, 4e-4, 96).reshape(8, 12)
    relief = tc.PhaseMask(heights, 0.02, 1.5)
    figure = tc.plot.mask(relief, wavelength=5e-4, samples=12)
    phase = figure.axes[1].images[0].get_array()
    turns = 2 * np.pi * 0.5 * heights / 5e-4
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * turns), atol=1e-9)
