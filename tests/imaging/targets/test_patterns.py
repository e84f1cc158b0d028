"""Edges, stars and points against areas, frequencies and places known in closed form."""

import math

import numpy as np
import pytest

from thincam_jax.imaging.targets import siemens_star
from thincam_jax.imaging.targets.patterns import point_grid, slanted_edge


def coordinates(shape):
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return y[:, None], x[None, :]


@pytest.mark.parametrize("shape", [(41, 60), (50, 33)])
@pytest.mark.parametrize("angle", [0.0, math.radians(5), math.radians(-12), 1e-9])
def test_every_row_of_an_edge_holds_the_area_right_of_it(shape, angle):
    """The mean of x over a row's height puts the edge at −y·tan(angle) exactly."""
    image = slanted_edge(shape, angle, low=0.1, high=0.9)
    y, _ = coordinates(shape)
    right = shape[1] / 2 + y[:, 0] * math.tan(angle)
    assert image.sum(axis=1) == pytest.approx(0.1 * shape[1] + 0.8 * right, abs=1e-9)


def test_edge_against_supersampling():
    shape, angle, fine = (12, 17), math.radians(25), 64
    y, x = coordinates((shape[0] * fine, shape[1] * fine))
    inside = x * math.cos(angle) + y * math.sin(angle) > 0
    expected = inside.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    assert np.abs(slanted_edge(shape, angle, 0.0, 1.0) - expected).max() < 2 / fine


def ring(image, radius, count):
    """The image along a circle, interpolated linearly, from +x towards +y."""
    angle = 2 * np.pi * np.arange(count) / count
    y = radius * np.sin(angle) + (image.shape[0] - 1) / 2
    x = radius * np.cos(angle) + (image.shape[1] - 1) / 2
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = y - i, x - j
    upper = (1 - b) * image[i, j] + b * image[i, j + 1]
    lower = (1 - b) * image[i + 1, j] + b * image[i + 1, j + 1]
    return (1 - a) * upper + a * lower


@pytest.mark.parametrize("spokes", [9, 36])
@pytest.mark.parametrize("shape", [(200, 231), (231, 200)])
def test_every_ring_of_a_star_has_one_period_for_each_spoke(shape, spokes):
    image = siemens_star(shape, spokes=spokes)
    for radius in (40, 60, 80):
        spectrum = np.fft.rfft(ring(image, radius, 2048)) / 2048
        assert np.argmax(np.abs(spectrum[1:])) + 1 == spokes
        assert spectrum[0].real == pytest.approx(0.5, abs=0.01)
        assert spectrum[spokes].real > 0  # bright along +x
        assert abs(spectrum[spokes].imag) < 1e-3


def test_beyond_nyquist_a_star_is_its_mean():
    image = siemens_star((301, 260), spokes=60)
    y, x = coordinates(image.shape)
    radius = np.hypot(y, x)
    nyquist = 60 / np.pi  # spokes/(2πr) = 1/2
    assert np.all(image[radius < nyquist] == 0.5)
    assert np.ptp(image[(radius > 1.2 * nyquist) & (radius < 1.5 * nyquist)]) > 0.5
    assert np.all(image[radius > 0.475 * 260 + 1] == 0.0)


def test_points_stand_in_the_middle_of_equal_cells():
    image = point_grid((20, 45), (2, 3))
    assert np.argwhere(image).tolist() == [[5, 7], [5, 22], [5, 37], [15, 7], [15, 22], [15, 37]]
    assert image.sum() == 6.0
    assert np.argwhere(point_grid((7, 11), (1, 1))).tolist() == [[3, 5]]
    assert point_grid((3, 4), (3, 4)).min() == 1.0
