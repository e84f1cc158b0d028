"""Norms from one-dimensional factors, against the images written out."""

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax._core.grids import Grid
from thincam_jax.lensless.accuracy.probe import distance, factors, norm, rounding_distance
from thincam_jax.lensless.propagation.separable import SeparableSum

SHAPE = (17, 23)
ONES = [np.ones(n) for n in SHAPE]


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
    given = [factors(terms, *ONES) for terms in (first, second)]
    assert norm(given[0]) == pytest.approx(np.linalg.norm(image(first)), rel=1e-13)
    expected = np.linalg.norm(image(first) - image(second))
    assert distance(*given) == pytest.approx(expected, rel=1e-13)
    assert distance(given[0], given[0]) <= 1e-7 * norm(given[0])


def test_weights_repeat_rows_and_columns():
    """A weight of n is n equal rows; a weight of zero is none."""
    terms = random_terms(3)
    weights = [np.random.default_rng(n).integers(0, 4, n) for n in SHAPE]
    repeated = np.repeat(np.repeat(image(terms), weights[0], axis=0), weights[1], axis=1)
    given = factors(terms, *(w.astype(float) for w in weights))
    assert norm(given) == pytest.approx(np.linalg.norm(repeated), rel=1e-13)


@pytest.mark.parametrize("size", [1e-3, 1e-8, 1e-14])
def test_distance_of_nearly_equal_sums(size):
    """Right in all sizes, where the distance of the images' norms has long lost its digits."""
    first = random_terms(4)
    second = moved(first, size)
    given = [factors(terms, *ONES) for terms in (second, first)]
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
