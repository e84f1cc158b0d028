"""Pinholes, rings, lenslets, reliefs, and masks from numbers and files."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import thincam_jax as tc
from helpers import finite_difference, value_and_slope
from thincam_jax.lensless.masks.phase import MaskBlank, diffuser, voronoi_fresnel
from thincam_jax.units import nm, um


def test_round_pinhole_on_the_axis():
    """4 sin²(πa²/(2λd)) at a bright and at a dark distance, by the angular spectrum."""
    a, wavelength = 0.1, 500e-6
    mask = tc.RadialMask([1.0], a)
    for zones in (1.0, 1.5, 2.0):
        distance = a**2 / (wavelength * zones)
        camera = tc.LenslessCamera(mask, tc.Sensor((1, 1), 0.202 / 301), distance)
        method = tc.PsfMethod("angular_spectrum", mask_shape=(301, 301))
        h = tc.psf(camera, wavelength=wavelength, model=method, pixel_integration=False)
        assert float(h[0, 0]) == pytest.approx(4 * np.sin(np.pi * zones / 2) ** 2, abs=0.06)


def test_gradients_of_rings():
    """In values, width of a ring and place, under jit."""
    weights = jnp.asarray(np.random.default_rng(0).uniform(size=(31, 34)))

    def weighted(numbers):
        mask = tc.RadialMask(numbers[:3], numbers[3], centre=numbers[4:])
        return jnp.sum(weights * mask.sample(tc.Grid((31, 34), 0.023)))

    start = jnp.asarray([0.3, 0.9, 0.5, 0.1, 0.013, -0.02])
    value, slope = value_and_slope(weighted)
    found = slope(start)
    for i in range(6):
        direction = jnp.zeros(6).at[i].set(1.0)
        expected = finite_difference(value, start, direction, 1e-6)
        np.testing.assert_allclose(found[i], expected, rtol=1e-5)


def test_a_lens_focuses():
    """At the focal length a square lens gives (w²/(λf))² sinc² sinc²."""
    mask, wavelength, f, w = tc.LensletArray(4.0, 0.5), 500e-6, 4.0, 0.5
    camera = tc.LenslessCamera(mask, tc.Sensor((9, 12), 1e-3), f)
    found = tc.psf(camera, wavelength=wavelength, pixel_integration=False)
    y, x = ((np.arange(n) - (n - 1) / 2) * 1e-3 for n in (9, 12))
    lobes = np.outer(*(np.sinc(w * v / (wavelength * f)) for v in (y, x)))
    np.testing.assert_allclose(found, (w * w / (wavelength * f) * lobes) ** 2, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="give wavelength in mm"):
        mask.sample(camera.sensor.grid)


def test_masks_from_pictures(tmp_path):
    import PIL.Image

    def written(name, values):
        path = tmp_path / name
        PIL.Image.fromarray(np.asarray(values, np.uint8)).save(path)
        return path

    levels = np.array([[0, 255, 64], [255, 0, 0]])
    mask = tc.read_mask(written("mask.png", levels), 0.03)
    np.testing.assert_allclose(np.abs(mask.amplitude) ** 2, levels / 255, atol=1e-12)
    coloured = np.zeros((2, 3, 3))
    coloured[..., 0] = 200
    for path, message in (
        (written("black.png", np.zeros((2, 3))), "is black: no light passes"),
        (written("colour.png", coloured), "is coloured; give a grey image"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            tc.read_mask(path, 0.03)
        assert "\n" not in str(error.value)
    wide = written("wide.png", np.eye(400) * 255)
    with pytest.raises(ValueError, match=r"mask 1920 mm wide; .*: 0.012 for a mask 4.8 mm wide"):
        tc.read_mask(wide, 4.8)
    assert tc.read_mask(wide, 0.012).amplitude.shape == (400, 400)


WAVELENGTH = 500 * nm
BLANK = MaskBlank((300, 420), 2 * um, 1.5)


def test_a_diffuser_has_the_slope_and_the_correlation_it_is_asked_for(key):
    """rms slope s along both axes, autocovariance σ² exp(−r²/ℓ²) with s = √2 σ/ℓ."""
    length, slope = 16 * um, 0.05
    mask = diffuser(key, BLANK, correlation_length=length, rms_slope=slope)
    height = np.asarray(mask.height)
    assert height.min() == 0
    for axis in (0, 1):
        steps = np.diff(height, axis=axis) / (2 * um)
        # A difference over one cell is the slope's mean over it: (p/ℓ)²/4 too small.
        assert abs(np.sqrt(np.mean(steps**2)) / slope - 1) < 0.03
    sigma = slope * length / np.sqrt(2)
    flat = height - height.mean()
    assert abs(flat.std() / sigma - 1) < 0.05
    for lag in (4, 8, 12):
        expected = np.exp(-((lag * 2 * um / length) ** 2))
        for one, other in ((flat[lag:], flat[:-lag]), (flat[:, lag:], flat[:, :-lag])):
            assert abs(np.mean(one * other) / sigma**2 - expected) < 0.07
    # Gaussian: no skewness, no excess; opposite rims are unlike.
    scaled = flat / flat.std()
    assert abs(np.mean(scaled**3)) < 0.15 and abs(np.mean(scaled**4) - 3) < 0.3
    assert abs(np.mean(scaled[0] * scaled[-1])) < 0.5


def test_every_site_of_a_voronoi_fresnel_mask_is_a_focus(key):
    """Twelve lenses: twelve equal points on the sensor at their focal length, far above the rest.

    Lloyd's relaxation spreads them: the nearest two are much farther apart than random ones.
    """
    blank = MaskBlank((200, 260), 2 * um, 1.5)
    mask = voronoi_fresnel(key, blank, sites=12, focal_length=2.0, wavelength=WAVELENGTH)
    assert 0 <= float(mask.height.min()) and float(mask.height.max()) < 1 * um
    camera = tc.LenslessCamera(mask, tc.Sensor((200, 260), 2 * um), 2.0)
    method = tc.PsfMethod("angular_spectrum", oversampling=1)
    h = np.asarray(tc.psf(camera, wavelength=WAVELENGTH, model=method, pixel_integration=False))
    peak = (h == scipy.ndimage.maximum_filter(h, 15)) & (h > 0.3 * h.max())
    assert peak.sum() == 12
    places = np.argwhere(peak) * 2 * um
    near = np.sort(np.linalg.norm(places[:, None] - places, axis=-1), axis=1)[:, 1]
    even = np.sqrt(0.4 * 0.52 / 12)
    assert near.min() > 0.7 * even
