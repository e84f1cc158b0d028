"""Rows and columns that stand for all, norms by factors, and errors of sampled models."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax._core.grids import Grid, SparseGrid
from thincam_jax.lensless.accuracy.probe import (
    COUNT,
    chosen,
    distance,
    factors,
    norm,
    rounding_distance,
)
from thincam_jax.lensless.masks.phase import MaskBlank, diffuser, voronoi_fresnel
from thincam_jax.lensless.propagation.separable import SeparableSum
from thincam_jax.units import nm, um

SEEDS = range(300)


@pytest.mark.parametrize("count", [1, 2, 77, COUNT])
def test_few_are_all_taken_once(count):
    indices, weights = chosen(count, (3.0, 50.0), 5.0, seed=0)
    assert len(indices) == len(weights) == COUNT
    np.testing.assert_array_equal(indices[:count], np.arange(count))
    np.testing.assert_array_equal(weights, np.arange(COUNT) < count)


@pytest.mark.parametrize(
    ("count", "edges", "zone"),
    [
        (COUNT + 1, (20.0, 200.0), 3.0),
        (700, (100.0, 600.0), 20.0),
        (700, (-400.0, 1100.0), 20.0),  # the shadow is larger than the sensor
        (5000, (2400.0, 2600.0), 1.0),
        (3000, (0.0, 2999.0), 1e4),  # all is edge
        (20000, (7000.5, 7900.2), 300.0),
    ],
)
def test_estimates_are_unbiased(count, edges, zone):
    """Sums of a smooth and of a peaked function over all indices, in the mean over seeds.

    The weights of a single choice add up to within a percent; a peak that is as narrow as the
    closely looked-at part around it is off by up to 0.25, measured.
    """
    position = np.arange(count)
    functions = (
        np.ones(count),
        1.5 + np.sin(9 * position / count),
        1 / (1 + ((position - edges[0]) / max(zone, 4.0)) ** 2),
    )
    drawn = [chosen(count, edges, zone, seed) for seed in SEEDS]
    for function, scatter in zip(functions, (0.01, 0.01, 0.3), strict=True):
        sums = np.array([np.sum(weights * function[indices]) for indices, weights in drawn])
        sums /= function.sum()
        assert abs(sums.mean() - 1) < 1e-3 + 3 * sums.std() / np.sqrt(len(SEEDS))
        assert sums.std() < scatter


def test_edges_are_looked_at_closely():
    """60 of 5000 indices are near an edge: half of all that is looked at, none of them twice over.

    Even density would put three there.
    """
    indices, weights = chosen(5000, (1000.0, 4000.0), 15.0, seed=3)
    near = np.minimum(np.abs(indices - 1000), np.abs(indices - 4000)) <= 15
    assert 55 <= len(np.unique(indices[near])) <= 62
    assert weights[near].max() < 1.5 < weights[~near].min()
    far, _ = chosen(5000, (-9000.0, 14000.0), 15.0, seed=3)
    assert np.diff(far).max() < 3 * 5000 / COUNT


def test_a_seed_is_a_choice():
    first, second, other = (chosen(900, (9.0, 80.0), 5.0, seed)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


@pytest.mark.parametrize("factor", quick([1, 3, 5], 1))
def test_points_are_those_of_the_grid(factor):
    """Coordinates, and the samples that a pixel is divided into: those of the finer grid."""
    grid = Grid((40, 9), jnp.asarray(0.02))
    indices = [np.array([0, 7, 39]), np.array([8, 2])]
    centred = [i - (n - 1) / 2 for i, n in zip(indices, grid.shape, strict=True)]
    points = SparseGrid(*centred, grid.pitch)
    assert points.shape == (3, 2)
    np.testing.assert_allclose(points.y, grid.y[indices[0]], rtol=1e-14)
    np.testing.assert_allclose(points.x, grid.x[indices[1]], rtol=1e-14)
    fine, refined = Grid((40 * factor, 9 * factor), grid.pitch / factor), points.refined(factor)
    np.testing.assert_allclose(
        np.reshape(refined.y, (3, factor)), np.reshape(fine.y, (40, factor))[indices[0]], atol=1e-14
    )
    np.testing.assert_allclose(
        np.reshape(refined.x, (2, factor)), np.reshape(fine.x, (9, factor))[indices[1]], atol=1e-14
    )


SHAPE = (17, 23)
ONES = tuple(np.ones(n) for n in SHAPE)


def random_terms(seed, count=4):
    rng = np.random.default_rng(seed)
    values = [rng.normal(size=(count, n)) + 1j * rng.normal(size=(count, n)) for n in SHAPE]
    return SeparableSum(*map(jnp.asarray, values), Grid(SHAPE, 0.01))


def moved(terms, size, seed=9):
    """Every factor changed by `size` of itself at random: what rounding does."""
    rng = np.random.default_rng(seed)
    change = [1 + size * rng.normal(size=v.shape) for v in (terms.rows, terms.columns)]
    return SeparableSum(
        terms.rows * change[0].astype(complex),
        terms.columns * change[1].astype(complex),
        terms.grid,
    )


def image(terms):
    rows, columns = (np.asarray(v) for v in (terms.rows, terms.columns))
    return np.einsum("ty,tx->yx", rows, columns).real


def test_norm_and_distance():
    first, second = random_terms(1), random_terms(2, count=6)
    given = [factors(terms.rows, terms.columns, ONES) for terms in (first, second)]
    assert norm(given[0]) == pytest.approx(np.linalg.norm(image(first)), rel=1e-13)
    expected = np.linalg.norm(image(first) - image(second))
    assert distance(*given) == pytest.approx(expected, rel=1e-13)
    assert distance(given[0], given[0]) <= 1e-7 * norm(given[0])


def test_weights_repeat_rows_and_columns():
    """A weight of n is n equal rows; a weight of zero is none."""
    terms = random_terms(3)
    weights = tuple(np.random.default_rng(n).integers(0, 4, n) for n in SHAPE)
    repeated = np.repeat(np.repeat(image(terms), weights[0], axis=0), weights[1], axis=1)
    given = factors(terms.rows, terms.columns, tuple(w.astype(float) for w in weights))
    assert norm(given) == pytest.approx(np.linalg.norm(repeated), rel=1e-13)


@pytest.mark.parametrize("size", [1e-3, 1e-8, 1e-14])
def test_distance_of_nearly_equal_sums(size):
    """Right in all sizes, where the distance of the images' norms has long lost its digits."""
    first = random_terms(4)
    second = moved(first, size)
    given = [factors(terms.rows, terms.columns, ONES) for terms in (second, first)]
    rows, columns = (np.asarray(v) for v in (first.rows, first.columns))
    down, across = (np.asarray(v) - w for v, w in ((second.rows, rows), (second.columns, columns)))
    # The differences of the factors are exact, so that those of the images keep their digits too.
    change = np.einsum("ty,tx->yx", down, np.asarray(second.columns))
    change = (change + np.einsum("ty,tx->yx", rows, across)).real
    expected = np.linalg.norm(change)
    assert 0 < expected < 100 * size * norm(given[1])
    assert rounding_distance(*given) == pytest.approx(expected, rel=1e-6)
    if size < 1e-10:
        assert abs(distance(*given) / expected - 1) > 0.1


WAVELENGTH = 532 * nm
KEY = jax.random.key(11)
BLANK = MaskBlank((40, 48), 5 * um, 1.5)


def camera(name):
    if name == "diffuser":
        mask = diffuser(KEY, BLANK, correlation_length=20 * um, rms_slope=0.02)
    elif name == "lenses":
        mask = voronoi_fresnel(KEY, BLANK, sites=3, focal_length=4.0, wavelength=WAVELENGTH)
    else:
        mask = BLANK.mask(np.random.default_rng(0).uniform(0, 1e-3, (40, 48)))
    return tc.LenslessCamera(mask, tc.Sensor((36, 40), 5 * um), 4.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "average"),
    [("diffuser", False), ("lenses", True), ("cells", False), ("lenses", False), ("cells", True)],
)
def test_predicted_errors_are_at_least_the_true_ones(name, average):
    """Against 11 samples a pixel and a window of three times the width."""
    here = camera(name)
    light = {"wavelength": WAVELENGTH, "pixel_integration": average}
    choice = tc.choose_model(here, tolerance=0.05 if name == "cells" else 0.02, **light)
    assert choice.method.model == "angular_spectrum" and choice.meets_tolerance
    finest = tc.PsfMethod("angular_spectrum", oversampling=11, mask_shape=(120, 128))
    best = tc.psf(here, model=finest, **light)
    for tried in choice.considered:
        found = tc.psf(here, model=tried.method, **light)
        true = relative_l2(found, best)
        assert true < tried.predicted_error < 12 * true + 1e-6, (tried, true)
    assert "has no exact PSF" in choice.reasons[0]


@pytest.mark.thorough
def test_a_choice_beyond_reach_says_so():
    choice = tc.choose_model(
        camera("diffuser"), wavelength=WAVELENGTH, tolerance=1e-9, pixel_integration=False
    )
    assert not choice.meets_tolerance
    assert [p.method.oversampling for p in choice.considered] == [1, 3, 5, 7]
    assert choice.predicted_error == choice.considered[-1].predicted_error
