"""The Pareto front of a set of points."""

import numpy as np
import pytest

from thincam_jax.design import non_dominated


def brute(points, larger):
    """By the definition, point by point."""
    signs = [-1 if more else 1 for more in larger]

    def beats(one, other):
        pairs = [(s * a, s * b) for s, a, b in zip(signs, one, other, strict=True)]
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)

    return np.array([not any(beats(other, one) for other in points) for one in points])


@pytest.mark.parametrize("larger", [(False, True), (True, True), (False, False, True)])
def test_against_the_definition(larger):
    """Small whole numbers: many points agree in some or in all objectives."""
    random = np.random.default_rng(len(larger))
    for count in (1, 2, 5, 40):
        points = random.integers(0, 6, (count, len(larger))).astype(float)
        np.testing.assert_array_equal(non_dominated(points, larger=larger), brute(points, larger))
    points = random.normal(size=(200, len(larger)))
    front = non_dominated(points, larger=larger)
    np.testing.assert_array_equal(front, brute(points, larger))
    assert 0 < front.sum() < 200


def test_directions_ties_and_what_is_no_number():
    points = np.array(
        [[1.0, 5.0], [2.0, 5.0], [2.0, 7.0], [2.0, 7.0], [np.nan, 9.0], [0.0, np.nan]]
    )
    assert (
        non_dominated(points, larger=(False, True)).tolist()
        == [True, False, True, True] + [False] * 2
    )
    assert non_dominated(points, larger=(True, False)).tolist() == [False, True] + [False] * 4
    assert non_dominated(np.zeros((0, 2)), larger=(True, False)).shape == (0,)
    infinite = np.array([[1.0, np.inf], [2.0, np.inf]])
    assert non_dominated(infinite, larger=(False, True)).tolist() == [True, False]


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.zeros(3)])
def test_an_objective_without_a_direction_is_refused(points):
    with pytest.raises((ValueError, TypeError)):
        non_dominated(points, larger=(True, False))
    with pytest.raises(ValueError, match="larger has 1 entries; give"):
        non_dominated(np.zeros((3, 2)), larger=(True,))
