"""Few columns stand for many."""

import numpy as np

from thincam_jax.lensless.plan.choose import fit, order_of_columns


def columns_of_rank(rank, count, random):
    """Complex columns, each a real combination of a few."""
    basis = random.normal(size=(40, rank)) + 1j * random.normal(size=(40, rank))
    return basis @ random.normal(size=(rank, count))


def test_as_many_columns_as_the_rank_reproduce_all():
    columns = columns_of_rank(4, 19, np.random.default_rng(0))
    order = order_of_columns(columns)
    assert sorted(order) == list(range(19))
    chosen = columns[:, order[:4]]
    for column in columns.T:
        weights = fit(chosen, column)
        np.testing.assert_allclose(chosen @ weights, column, atol=1e-10)
    worse = columns[:, order[:3]]
    missed = [np.linalg.norm(worse @ fit(worse, c) - c) / np.linalg.norm(c) for c in columns.T]
    assert max(missed) > 0.05


def test_the_largest_column_comes_first():
    random = np.random.default_rng(1)
    columns = columns_of_rank(6, 6, random)
    columns[:, 4] *= 50
    assert order_of_columns(columns)[0] == 4


def test_weights_are_real():
    """A column times j is no multiple of it: images cannot be mixed with complex weights."""
    column = np.array([1.0 + 2.0j, -0.5j])
    np.testing.assert_allclose(fit(column[:, None], 1j * column), [0.0], atol=1e-14)
