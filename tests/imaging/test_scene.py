"""Image planes: totals, scale, orientation; spectra and scenes, and what they refuse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from helpers import finite_difference, quick
from thincam_jax._core.grids import Grid
from thincam_jax.imaging.scene import ImagePlane, Scene, Spectrum
from thincam_jax.units import nm


def picture(shape, seed=0):
    """Noise: no symmetry that could hide a flip."""
    return np.random.default_rng(seed).uniform(0.1, 1.0, shape)


@eqx.filter_jit
def compiled(plane, grid, magnification):
    return plane.sample(grid, magnification=magnification)


def sample(plane, grid, magnification):
    """In one program, not operation by operation."""
    return compiled(plane, grid, jnp.asarray(magnification))


def averages_by_running_totals(image, width, grid, magnification, shift=0.0):
    """Cell averages from the image's running total, interpolated linearly at the cells' edges.

    `shift`: of the image along +x, before it is scaled.
    """
    rows, columns = image.shape
    pixel = width * abs(magnification) / columns
    turned = image[::-1, ::-1] if magnification < 0 else image

    def along(values, count, samples, shift=0.0):
        edges = (np.arange(count + 1) - count / 2) * pixel + shift
        total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        cells = (np.arange(samples + 1) - samples / 2) * float(grid.pitch)
        return np.stack(
            [np.diff(np.interp(cells, edges, column)) for column in total.T], axis=-1
        ) * (pixel / float(grid.pitch))

    down = along(turned, rows, grid.shape[0])
    return along(down.T, columns, grid.shape[1], shift * magnification).T


@pytest.mark.parametrize(
    ("pitch", "magnification"), quick([(0.031, -1.0), (0.11, 0.37), (0.7, -2.6)], 0, 2)
)
def test_totals_are_kept_at_any_ratio_of_the_pitches(pitch, magnification):
    """Light is neither lost nor made: Σ·pitch² is the sum of the pixels times their area."""
    image = picture((2, 5, 8))
    plane = ImagePlane(image, 100.0, 1.6)
    size = np.array([1.0, 1.6]) * abs(magnification)
    # just large enough, the two axes with one more and two more cells: odd and even counts
    rows, columns = np.ceil(size / pitch).astype(int)
    grid = Grid((rows + 1, columns + 2), pitch)
    sampled = sample(plane, grid, magnification)
    area = (1.6 * magnification / 8) ** 2
    np.testing.assert_allclose(
        sampled.sum(axis=(1, 2)) * pitch**2, image.sum(axis=(1, 2)) * area, rtol=1e-12
    )


@pytest.mark.parametrize(
    ("shape", "magnification"), [((9, 14), -1.3), ((10, 7), -0.4), ((1, 5), 0.9)]
)
def test_cells_hold_the_exact_average(shape, magnification):
    image, grid = picture((6, 9)), Grid(shape, 0.13)
    sampled = sample(ImagePlane(image, 100.0, 1.8), grid, magnification)
    expected = averages_by_running_totals(image, 1.8, grid, magnification)
    np.testing.assert_allclose(sampled, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("moves", "magnification"), [((0.3, -0.9), -1.3), ((-0.2, -0.17), 0.9), ((0.3, 0.3), -0.4)]
)
def test_what_moves_is_the_mean_on_the_way(moves, magnification):
    """Against a sum over many places; on the way less than a cell, and no way at all."""
    image, grid = picture((6, 9)), Grid((9, 14), 0.13)
    plane = ImagePlane(image, 100.0, 1.8, moves)
    times = (np.arange(2000) + 0.5) / 2000
    places = moves[0] + (moves[1] - moves[0]) * times
    still = [averages_by_running_totals(image, 1.8, grid, magnification, x) for x in places]
    sampled = sample(plane, grid, magnification)
    np.testing.assert_allclose(sampled, np.mean(still, axis=0), atol=1e-6)


def test_a_pinhole_turns_the_image_by_180_degrees():
    image = picture((4, 7))
    plane = ImagePlane(image, 100.0, 0.7)
    grid = Grid((4, 7), 0.1)
    np.testing.assert_allclose(plane.sample(grid), image[::-1, ::-1], rtol=1e-12)
    np.testing.assert_allclose(sample(plane, grid, 1.0), image, rtol=1e-12)
    halved = sample(plane, Grid((8, 14), 0.1), -2.0)
    np.testing.assert_allclose(halved, np.kron(image[::-1, ::-1], np.ones((2, 2))), rtol=1e-12)


def test_the_scale_is_differentiable():
    """Averages are piecewise quadratic in the scale; the step stays within one piece."""
    image, weights, grid = picture((5, 8)), picture((6, 7), seed=1), Grid((6, 7), 0.13)

    def loss(width, magnification):
        sampled = ImagePlane(image, 100.0, width).sample(grid, magnification=magnification)
        return jnp.sum(weights * sampled)

    at = jnp.asarray(1.13), jnp.asarray(-0.71)
    both = jax.jit(jax.value_and_grad(loss, (0, 1)))
    for argument, slope in enumerate(both(*at)[1]):
        direction = tuple(jnp.asarray(float(i == argument)) for i in (0, 1))
        expected = finite_difference(lambda x: both(*x)[0], at, direction, 1e-4)
        np.testing.assert_allclose(slope, expected, rtol=1e-8)


def test_a_photograph_is_taken_as_it_is():
    """From a file, an array with the colours last, or PIL, with or without alpha."""
    counts = np.random.default_rng(0).integers(0, 256, (7, 6, 3)).astype(np.uint8)
    expected = np.moveaxis(counts, -1, 0) / 255
    opaque = np.dstack([counts, np.full((7, 6), 255, np.uint8)])
    for given in (counts, counts / 255, PIL.Image.fromarray(counts), opaque):
        np.testing.assert_allclose(ImagePlane(given, 10.0, 1.0).image, expected)
    deep = ImagePlane(np.array([[0, 65535]], np.uint16), 10.0, 1.0).image
    np.testing.assert_array_equal(deep, [[0, 1]])
    assert ImagePlane(jnp.asarray(expected), 10.0, 1.0).image.shape == (3, 7, 6)


def test_spectrum_weights():
    """By default an average; given weights are used as they are."""
    spectrum = Spectrum([450 * nm, 550 * nm, 600 * nm])
    np.testing.assert_allclose(spectrum.weights, 1 / 3)
    np.testing.assert_allclose(spectrum.wavelengths, [4.5e-4, 5.5e-4, 6e-4])
    np.testing.assert_array_equal(Spectrum([450 * nm, 550 * nm], [2.0, 0.0]).weights, [2.0, 0.0])
    single = Spectrum(500 * nm)
    np.testing.assert_array_equal(single.weights, [1.0])
    assert single.wavelengths.shape == (1,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([500e-9],), "5e-07 mm is no light: give it in mm, not in m, such as"),
        (([500 * nm, 600 * nm], [1.5, -0.5]), "weights .* negative"),
    ],
)
def test_impossible_spectra(arguments, message):
    with pytest.raises(ValueError, match=message):
        Spectrum(*arguments)


def test_a_wavelength_is_light_of_one_colour():
    plane = ImagePlane(picture((3, 4)), 10.0, 1.0)
    guessed = Scene(plane, wavelength=530 * nm)
    assert eqx.tree_equal(guessed, Scene(plane, Spectrum(530 * nm)), Scene(plane, 530 * nm))
    both = {"spectrum": Spectrum(530 * nm), "wavelength": 530 * nm}
    for light, fault in (({}, "is missing"), (both, "is given twice")):
        with pytest.raises(TypeError, match=rf"^the light of the Scene {fault}; give wavelength="):
            Scene(plane, **light)


def test_a_filter_multiplies_the_shares():
    light = Spectrum([480 * nm, 520 * nm, 560 * nm, 700 * nm], [1.0, 2.0, 1.0, 1.0])
    green = light.filtered([500 * nm, 540 * nm, 600 * nm], [0.2, 1.0, 0.4])
    np.testing.assert_allclose(green.weights, [0.0, 1.2, 0.8, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(green.wavelengths, light.wavelengths)


@pytest.mark.parametrize(
    ("places", "curve", "message"),
    [
        ([500 * nm], [1.0], "two lists of one length, of two or more"),
        ([500 * nm, 600 * nm], [1.0], "two lists of one length"),
        ([600 * nm, 500 * nm], [1.0, 1.0], "ascending order"),
        ([500 * nm, 600 * nm], [1.0, -1.0], "negative share"),
    ],
)
def test_wrong_filters(places, curve, message):
    light = Spectrum([520 * nm, 590 * nm])
    with pytest.raises(ValueError, match=message):
        light.filtered(places, curve)
