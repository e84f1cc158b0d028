"""Sensitivity around a design: the change that costs 1 %, against closed forms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from design import small

from thincam_jax.design import BayesError, DesignSpace, FrequencyCounts, sensitivity_around
from thincam_jax.design.search import Found
from thincam_jax.design.sensitivity import least_change, uncoupled
from thincam_jax.design.setup import Quadrant
from thincam_jax.design.space import Limits


@dataclasses.dataclass(frozen=True)
class Bowl(BayesError):
    """1 + (β₁ − 20)² + 2 (β₂ − 15)² + d₁ of pairs; exactly with 0.3 (β₁ − 16)² more."""

    def value(self, design, data):
        first, second = design.beta[0], design.beta[2]
        value = 1 + (first - 20) ** 2 + 2 * (second - 15) ** 2 + design.distance[0]
        return value + (0.3 * (first - 16) ** 2 if isinstance(data.frequencies, Quadrant) else 0)


def found_at(problem, *values) -> Found:
    space = problem.space
    point = small.point_of(space, *values)
    design = space.design(point)
    cost = float(problem.objective(design, problem.data))
    return Found(design, space.values(point), cost, "converged", ("a",), point)


def test_tolerance_is_a_change_of_one_per_cent():
    """Of the exact objective: 8.8 at (20, 15), with a slope of 2.4 and a curvature of 2.6."""
    problem = small.problem(Bowl())
    around = sensitivity_around(problem, found_at(problem, 20.0, 15.0))
    first, second = around.values
    assert (first.variable, first.shots, second.shots) == ("beta", (1,), (2,))
    assert (first.value, second.value) == pytest.approx((20, 15))
    # 2.4 δ + 1.3 δ² = 0.088, and 2 δ² = 0.088.
    assert first.tolerance == pytest.approx((np.sqrt(2.4**2 + 5.2 * 0.088) - 2.4) / 2.6)
    assert second.tolerance == pytest.approx(np.sqrt(0.044))
    assert around.increase == pytest.approx(0.088)
    np.testing.assert_allclose(around.derivatives.slopes, [2.4, 0], atol=1e-9)
    np.testing.assert_allclose(around.derivatives.curvatures, [2.6, 4])
    assert str(around).splitlines() == [
        "β of shot 1, rad/mm²: 20.00 (±0.036)",
        "β of shot 2, rad/mm²: 15.00 (±0.21)",
    ]


def function(design, data):
    return (design.beta[0] - 20.0) ** 2 + 2.0


def test_of_a_plain_function():
    problem = dataclasses.replace(small.problem(), objective=function, exact=None)
    first, second = sensitivity_around(problem, found_at(problem, 20.0, 15.0)).values
    assert first.tolerance == pytest.approx(np.sqrt(0.02))
    assert second.tolerance is None and str(second) == "15.00"


@pytest.mark.thorough
def test_of_an_actual_objective(monkeypatch):
    """A change by the tolerance costs 1 %, on one side or the other, but for ripples of 0.02 dB."""
    monkeypatch.setattr(small, "COUNTS", FrequencyCounts(radii=64, directions=1))
    problem = small.problem()
    one = found_at(problem, 20.0, 15.0)
    value = sensitivity_around(problem, one).values[0]
    assert value.tolerance is not None and 0 < value.tolerance < 1
    costs = [
        float(problem.objective(found_at(problem, 20.0 + off, 15.0).design, problem.exact))
        for off in (-value.tolerance, 0.0, value.tolerance)
    ]
    assert max(costs) / costs[1] == pytest.approx(1.01, abs=4e-3)


@dataclasses.dataclass(frozen=True)
class Slope(BayesError):
    """1 + (β − 14)²/4 + 3 (width − 1.5)²."""

    def value(self, design, data):
        return 1 + (design.beta[0] - 14) ** 2 / 4 + 3 * (design.width - 1.5) ** 2


def test_the_tolerance_of_a_width_holds_beta():
    """Mask pixels tie β to the width in the search's cube, and not in a tolerance."""
    variables = (small.shared("beta", 12.0, 30.0, 2), small.shared("width", 1.0, 2.5, 0))
    limits = Limits(mask_pixel=0.08)
    problem = small.problem(Slope(), variables, small.pairs([15.0]), limits)
    finest = np.pi / 0.08 / 1.5
    point = jnp.asarray([(1.5 - 1) / 1.5, (14.0 - 12) / (finest - 12)])
    design, values = problem.space.design(point), problem.space.values(point)
    np.testing.assert_allclose(values, [1.5, 14.0])
    found = Found(design, values, 1.0, "converged", (), point)
    width, beta = sensitivity_around(problem, found).values
    assert (width.variable, width.shots, beta.shots) == ("width", (), (1,))
    assert width.tolerance == pytest.approx(np.sqrt(0.01 / 3))
    assert beta.tolerance == pytest.approx(0.2)


def test_uncoupled_within_the_limits():
    """Its sides end where the search's do, at the width of the design."""
    betas = [dataclasses.replace(v, upper=500.0) for v in small.BETAS]
    variables = (*betas, small.shared("distance", 2.0, 50.0))
    space = DesignSpace(small.pairs(), variables, Limits(mask_pixel=0.04, thickness=3.0))
    alone, place, spans = uncoupled(space, jnp.asarray([0.1, 0.5, 1.0]))
    np.testing.assert_allclose(spans, [np.pi / 0.04 / 2 - 12] * 2 + [1.0])
    np.testing.assert_allclose(place, [0.1, 0.5, 1.0], atol=1e-12)
    assert alone.limits.mask_pixel is None


@pytest.mark.parametrize(
    ("slope", "curvature", "increase", "change"),
    [(0.0, 2.0, 0.01, 0.1), (2.0, 0.0, 0.01, 0.005), (-3.0, 8.0, 1.0, 0.25)],
)
def test_change_that_costs_an_increase(slope, curvature, increase, change):
    assert least_change(slope, curvature, increase) == pytest.approx(change)


def test_where_no_change_costs_anything():
    assert least_change(0.0, 0.0, 1.0) is None
    assert least_change(0.0, -1.0, 1.0) is None
