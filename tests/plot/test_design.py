"""Figures of a design: what is drawn, where, and in which units."""

from dataclasses import replace

import numpy as np
import pytest
from design import small
from studies.test_design_result import fronts

from thincam_jax.design import BayesError
from thincam_jax.design.landscape import Landscape
from thincam_jax.design.ranking import RankedDesign
from thincam_jax.design.sensitivity import FreeValue
from thincam_jax.plot.design import draw_fronts, draw_objective, draw_responses
from thincam_jax.studies.design import FoundDesigns


def result(**changed):
    found = RankedDesign(
        "found 1",
        small.pairs([20.0, 17.0]),
        0.1,
        0.09,
        np.ones(64),
        (FreeValue("beta", (1,), 20.0, 0.1), FreeValue("beta", (2,), 17.0, None)),
    )
    old = replace(found, name="pairs", design=small.pairs())
    axis = np.linspace(12, 30, 7)
    costs = np.linspace(0.09, 0.4, 49).reshape(7, 7)
    named = (("beta", (1,)), ("beta", (2,)))
    around = Landscape(named, (axis, axis), costs, BayesError())
    whole = FoundDesigns(BayesError(), old, (found,), 1, 0, 2.5, 18.75, around)
    return replace(whole, **changed)


def test_landscape_with_the_designs():
    figure = draw_objective(result(), 1)
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels == ["pairs (-10.46 dB)", "found 1 (-10.46 dB)"]
    assert draw_objective(result(landscape=None), 1) is None


def test_frequencies_on_the_sensor():
    figure = draw_responses(result(), 1, 0.04)
    ax = figure.axes[0]
    top = ax.child_axes[0]
    figure.draw_without_rendering()
    assert ax.get_xlim()[1] == 18.75
    assert top.get_xlim()[1] == pytest.approx(6.25)
    assert "12.5" in top.get_xlabel()
    assert ax.lines[0].get_xdata()[0] == pytest.approx(18.75 / 128)


def test_fronts():
    scores = fronts()
    figure = draw_fronts(scores, "pairs", 100.0)
    assert [ax.get_xlabel().split(":")[0] for ax in figure.axes] == [
        *("thickness", "captures", "light")
    ]
    drawn = {line.get_label(): line for line in figure.axes[0].lines}
    assert drawn["on the front"].get_markerfacecolor() == "black"
    np.testing.assert_array_equal(drawn["on the front"].get_xydata(), [[2, 10], [2.5, 12]])
    hollow = drawn["dominated by one of lower cost"]
    assert hollow.get_markerfacecolor() == "white"
    np.testing.assert_array_equal(hollow.get_xydata(), [[3, 12]])
    np.testing.assert_array_equal(drawn["pairs"].get_xydata(), [[3, 11]])
    assert figure.axes[2].get_xscale() == "log"
    alone = draw_fronts(replace(scores, thickness=None, captures=None), "pairs", 100.0)
    assert len(alone.axes) == 1
