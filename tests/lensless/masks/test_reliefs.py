"""Diffusers have the statistics they are asked for, Voronoi-Fresnel masks one focus a site."""

import jax
import numpy as np
import pytest
import scipy.ndimage

import thincam_jax as tc
from thincam_jax.lensless.masks.phase import MaskBlank, diffuser, voronoi_fresnel
from thincam_jax.units import nm, um

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


def test_a_diffuser_is_its_keys(key):
    other = jax.random.split(key)[0]
    first, again, another = (
        np.asarray(diffuser(k, BLANK, correlation_length=16 * um, rms_slope=0.1).height)
        for k in (key, key, other)
    )
    np.testing.assert_array_equal(first, again)
    assert np.corrcoef(first.ravel(), another.ravel())[0, 1] < 0.5


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


def test_refuses(key):
    with pytest.raises(ValueError, match="correlation_length = 0.003 mm is 1.5 cells of the blank"):
        diffuser(key, BLANK, correlation_length=3 * um, rms_slope=0.1)
    lenses = {"focal_length": 2.0, "wavelength": WAVELENGTH}
    with pytest.raises(ValueError, match="sites = 0; give 1 to the number of cells"):
        voronoi_fresnel(key, BLANK, sites=0, **lenses)
    with pytest.raises(ValueError, match=r"a lens reaches .* give more sites, a longer focal_len"):
        voronoi_fresnel(key, BLANK, sites=1, **lenses)
    with pytest.raises(ValueError, match=r"height reaches from 0 to .*; give 0 to 0.1 mm"):
        diffuser(key, BLANK, correlation_length=16 * um, rms_slope=10.0)
    with pytest.raises(
        ValueError, match=r"height has shape \(3, 4\) and the blank \(.*give as many"
    ):
        BLANK.mask(np.zeros((3, 4)))
