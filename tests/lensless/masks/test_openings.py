"""Pinholes, rings, lenslets and masks from numbers and files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, value_and_slope
from thincam_jax.lensless.masks import random_cells


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


@pytest.mark.thorough
def test_rings_are_sampled_by_their_area():
    rings = np.array([0.0, 1.0, 0.25])
    mask = tc.RadialMask(rings, 0.1, centre=(0.013, -0.02))
    value = np.asarray(mask.sample(tc.Grid((31, 34), 0.023)))
    radii = 0.1 * np.arange(4)
    expected = np.sum(rings * np.pi * np.diff(radii**2))
    assert value.sum() * 0.023**2 == pytest.approx(expected, rel=1e-12)
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.023 for n in (31, 34))
    inside = np.hypot(y[:, None] - 0.013, x + 0.02) < 0.1 - 0.023
    assert np.abs(value[inside]).max() < 1e-12


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


@pytest.mark.thorough
def test_light_behind_rings_arrives():
    """All that passes them falls on a sensor that is wide enough; vmap is a loop."""
    mask = tc.RadialMask([1.0, 0.0, 0.5], 0.05)
    passed = np.pi * 0.05**2 * (1 + 0.25 * (9 - 4))

    def one(distance):
        camera = tc.LenslessCamera(mask, tc.Sensor((100, 104), 5e-3), distance)
        method = tc.PsfMethod("angular_spectrum", oversampling=3, mask_shape=(64, 64))
        return tc.psf(camera, wavelength=500e-6, model=method, pixel_integration=True)

    several = jax.jit(jax.vmap(one))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(several[0], one(1.0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(several.sum(axis=(1, 2)) * 5e-3**2 / passed, 1, rtol=0.02)


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


def test_random_cells():
    mask = random_cells(jax.random.key(0), 1.2, 0.03, height=0.6, open_fraction=0.3)
    same = random_cells(0, 1.2, 0.03, height=0.6, open_fraction=0.3)
    assert (same.amplitude == mask.amplitude).all()
    assert mask.amplitude.shape == (20, 40)
    assert abs(float(mask.amplitude.mean()) - 0.3) < 0.06
    # In single precision 12000 cells of 0.1 µm are some 1e-8 mm off.
    assert random_cells(jax.random.key(0), np.float32(1.2), np.float32(1e-4), height=1e-3)
    with pytest.raises(ValueError, match=r"width = 1 mm is not a whole .* give width = 2 mm$"):
        random_cells(jax.random.key(0), 1.0, 2.0)


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
