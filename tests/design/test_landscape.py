"""Landscapes: over which numbers, their values, and the labelled plot."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from design import small
from design.test_sensitivity import Bowl, Slope, found_at

from thincam_jax.design import BayesError, DesignSpace, Variable, landscape_around
from thincam_jax.design.landscape import Landscape, drawn_variables, evaluate_grid, landscape_if_any
from thincam_jax.design.objectives import ResolutionLimit, Unevenness, WorstRatio
from thincam_jax.design.space import Limits


def waves(design, data):
    x = (design.beta[0] - data) / 28.0
    return 0.2 + 4 * x**2 + 0.4 * (1 - np.cos(0) * (1 - x**2))


def test_of_two_variables():
    problem = small.problem(Bowl())
    around = landscape_around(problem, problem.space.base, count=5)
    assert around.variables == (("beta", (1,)), ("beta", (2,)))
    np.testing.assert_allclose(around.axes, [[12, 16.5, 21, 25.5, 30]] * 2)
    assert around.costs.shape == (5, 5)
    # Along the first axis the first variable: 1 + 3.5² + 2 · 10.5² + 3.
    assert around.costs[1, 3] == pytest.approx(1 + 3.5**2 + 2 * 10.5**2 + 3)
    np.testing.assert_allclose(around.values, 10 * np.log10(around.costs))


def test_of_one_and_of_three_variables():
    """One is a line; of more, the first two, the others as in the given design."""
    one = (small.shared("beta", 12.0, 30.0),)
    problem = small.problem(Bowl(), one)
    line = landscape_around(problem, problem.space.base, count=3)
    assert line.variables == (("beta", (1, 2)),)
    expected = [1 + (b - 20) ** 2 + 2 * (b - 15) ** 2 + 3 for b in (12, 21, 30)]
    np.testing.assert_allclose(line.costs, expected)
    problem = small.problem(Bowl(), (*small.BETAS, small.shared("distance", 2.0, 3.0)))
    best = found_at(problem, 20.0, 17.0, 2.2).design
    around = landscape_around(problem, best, count=3)
    assert around.costs[0, -1] == pytest.approx(1 + 8**2 + 2 * 15**2 + 2.2)


def test_limits_narrow_it():
    """π / (0.08 mm · 2 mm) = 19.6 rad/mm²; at a thickness of 2 mm no room is left."""
    problem = small.problem(Bowl(), limits=Limits(mask_pixel=0.08))
    around = landscape_around(problem, found_at(problem, 13.0, 13.0).design, count=3)
    assert around.axes[0][-1] == pytest.approx(np.pi / 0.08 / 2)
    flat = (Variable("distance", 2.0, 3.0, (0, 1, 2, 3)),)
    problem = small.problem(Bowl(), flat, limits=Limits(thickness=2.0))
    assert landscape_if_any(problem, problem.space.base, 3) is None
    with pytest.raises(ValueError, match="widen their bounds"):
        landscape_around(problem, problem.space.base, count=3)


def test_over_a_width():
    """Not beside a β that mask pixels tie to it."""
    variables = (small.shared("beta", 12.0, 30.0, 2), small.shared("width", 1.0, 2.5, 0))
    design = small.pairs([14.0], width=1.5)
    tied = small.problem(Slope(), variables, small.pairs([15.0]), Limits(mask_pixel=0.08))
    around = landscape_around(tied, design, count=5)
    finest = np.pi / 0.08 / 1.5
    assert around.variables == (("beta", (1,)),)
    np.testing.assert_allclose(around.axes[0][-1], finest)
    np.testing.assert_allclose(around.costs[-1], 1 + (finest - 14) ** 2 / 4)
    free = small.problem(Slope(), variables, small.pairs([15.0]))
    assert landscape_around(free, design, count=5).variables == (("width", ()), ("beta", (1,)))


def made_up(objective=None, axes=2) -> Landscape:
    axis = np.linspace(12, 30, 7)
    named = tuple(("beta", (n,)) for n in range(1, axes + 1))
    costs = np.linspace(0.09, 0.4, 7**axes).reshape((7,) * axes)
    return Landscape(named, (axis,) * axes, costs, objective or BayesError())


@pytest.mark.parametrize("objective", [ResolutionLimit(), WorstRatio(), Unevenness()])
def test_other_objectives(objective):
    """The worst shade is that of the least where more is better; a line is labelled, too."""
    figure, axes = plt.subplots(1, 2)
    made_up(objective).plot(ax=axes[0])
    mesh = axes[0].collections[0]
    values = mesh.get_array()
    assert (mesh.norm.vmin > values.min()) == objective.maximised
    assert (mesh.norm.vmax < values.max()) == (not objective.maximised)
    made_up(objective, 1).plot({"a": small.pairs((21.0, 21.0))}, {"a": 0.3}, ax=axes[1])
    assert axes[1].get_ylabel() == objective.label
    (point,) = axes[1].lines[1].get_xydata()
    assert point == pytest.approx([21.0, -0.3 if objective.maximised else 0.3])
    plt.close(figure)


def test_which_numbers_are_drawn():
    base = small.pairs([25.0, 21.0, 17.0, 15.0])

    def names(*variables):
        return [v.name for v in drawn_variables(DesignSpace(base, variables))]

    width, beta = small.shared("width", 1.0, 2.0, 0), small.shared("beta", 12.0, 30.0, 8)
    one, two, three = (Variable("exposure", 0.2, 1.2, (2 * n, 2 * n + 1)) for n in range(3))
    assert names(width, beta, one) == ["beta", "exposure"]
    assert names(beta, one, two) == ["beta"]
    assert names(one, two) == ["exposure", "exposure"]
    assert names(width) == ["width"]
    assert names(one, two, three) == []


def test_a_design_without_a_cost_lies_on_the_line():
    figure = dataclasses.replace(made_up(axes=1), objective=len).plot({"a": small.pairs((21.0,))})
    (point,) = figure.axes[0].lines[1].get_xydata()
    assert point == pytest.approx([21.0, 0.245])
    assert figure.axes[0].get_ylabel() == "objective to minimise"
    plt.close(figure)


def test_an_even_grid():
    space = DesignSpace(small.pairs(), (Variable("beta", 8.0, 36.0, (0, 1)),))
    points, values = evaluate_grid(waves, space, 22.0, 57)
    assert points.shape == (57, 1)
    assert int(np.argmin(values)) == 28
    np.testing.assert_allclose(values[28], 0.2, rtol=1e-12)
    with pytest.raises(ValueError, match="2 or more a side and at most 10 million"):
        evaluate_grid(waves, DesignSpace(small.pairs(), small.BETAS), 22.0, 4000)
