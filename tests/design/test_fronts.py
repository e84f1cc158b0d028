"""Pareto fronts: which points lie on one, and fronts of designs by search."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design import small

from thincam_jax.design import DesignSpace, PhotonNoise, SearchSettings, find_front, fronts
from thincam_jax.design.fronts import non_dominated
from thincam_jax.design.objectives import ResolutionLimit
from thincam_jax.design.space import Limits
from thincam_jax.reconstruction import phase_pairs


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


SETTINGS = SearchSettings(starts=2, samples=8, steps=4)
DISTANCE = small.shared("distance", 2.0, 3.0)


def rising(values):
    return all(b >= a for a, b in zip(values, values[1:], strict=False))


@pytest.mark.thorough
def test_thickness_and_light_buy_resolution():
    """By searches; the problems of a front share one compiled program."""
    noise = PhotonNoise(900.0, 4.0)
    problem = small.problem(ResolutionLimit(), (*small.BETAS, DISTANCE), noise=noise)
    told = []
    thin = {cost: problem.with_thickness(cost) for cost in (2.0, 2.5, 3.0)}
    thickness = find_front(thin, SETTINGS, key=jax.random.key(3), progress=told.append)
    assert told == [2.0, 2.5, 3.0, 2.5, 2.0, 2.5, 3.0]
    lit = {cost: problem.with_electrons(cost) for cost in (90.0, 9e3, 9e5)}
    light = find_front(lit, SETTINGS, key=jax.random.key(3))
    assert [p.cost for p in thickness] == [2.0, 2.5, 3.0]
    for points in (thickness, light):
        values = [p.resolution for p in points]
        assert rising(values) and values[-1] > values[0] > 0
    for point in thickness:
        assert all(2.0 <= shot.distance <= point.cost + 1e-9 for shot in point.shots)
        assert all(12 <= shot.beta <= 30 for shot in point.shots)
    # No less than the base, which is a design at 3 mm.
    base = fronts.front_point(problem.space.base, problem.exact)
    assert thickness[-1].resolution >= 0.9 * base.resolution


@pytest.mark.thorough
def test_more_captures_have_less_error():
    """A search for more begins at the best of fewer, its last shot repeated."""
    problem = small.problem(noise=PhotonNoise(900.0, 4.0))
    problems = {}
    for count in (1, 2):
        space = DesignSpace(small.pairs([25.0, 21.0][:count]), small.BETAS[:count])
        problems[2.0 * count] = problem.with_captures(space, jnp.asarray(phase_pairs(count)))
    few, many = find_front(problems, SETTINGS, key=jax.random.key(3))
    assert (len(few.shots), len(many.shots)) == (1, 2)
    assert many.error < few.error
    longer = fronts._lengthened(few.design, problems[4.0].space.base)
    np.testing.assert_allclose(longer.beta, [few.shots[0].beta] * 4)
    assert float(longer.exposure[0]) == 1.0 and float(few.design.exposure[0]) == 2.0


def test_order_of_the_searches():
    """Alone, back from the last, and on again; captures beside the one before at once."""
    alone, back, on = [(0, None), (1, None), (2, None)], [(1, 2), (0, 1)], [(1, 0), (2, 1)]
    assert fronts.search_order(3, rising_captures=False) == [*alone, *back, *on]
    assert fronts.search_order(3, rising_captures=True) == [(0, None), (1, 0), (2, 1)]


def test_resolution_ends_where_frequencies_or_pixels_do(monkeypatch):
    problem, edge = small.problem(), 3.0 * 12.5 / 2
    for found, distance, resolution, ends in (
        (edge, 3.0, edge, "at the band's end"),
        (np.inf, 3.0, edge, "at the band's end"),
        (edge, 1.0, 12.5, "at the pixels' Nyquist frequency"),
        (7.0, 1.0, 7.0, ""),
    ):
        values = (jnp.asarray(found), jnp.asarray(0.1))
        monkeypatch.setattr(fronts, "_limit_and_error", lambda *_, values=values: values)
        near = eqx.tree_at(lambda d: d.distance, problem.space.base, jnp.full(4, distance))
        point = fronts.front_point(near, problem.exact)
        assert point.resolution == pytest.approx(resolution)
        assert point.ends == ends


def test_near_a_place_mask_pixels_hold():
    """β·width ≤ π/pixel in all of the neighbourhood, which has the place itself in it."""
    variables = (small.shared("beta", 5.0, 60.0), small.shared("width", 1.0, 2.5, 0))
    space = DesignSpace(small.pairs(), variables, Limits(mask_pixel=0.05))
    corners = jnp.asarray([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
    for place in ([0.5, 1.0], [0.1, 0.4], [1.0, 0.9]):
        near = fronts.neighbourhood(space, jnp.asarray(place))
        inside = np.asarray(near.point(space.design(jnp.asarray(place))))
        assert np.all((inside >= -1e-9) & (inside <= 1 + 1e-9))
        designs = jax.vmap(near.design)(corners)
        assert np.all(designs.beta[:, 0] * designs.width <= np.pi / 0.05 * (1 + 1e-9))
        assert np.all(near.upper > near.lower)
