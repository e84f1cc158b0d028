"""Figures of numbers: a solver's history, objectives, fronts and tolerances of designs."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from design import small

import thincam_jax as tc
from thincam_jax import Psfs
from thincam_jax.design.fronts import FrontPoint
from thincam_jax.design.sensitivity import Derivatives, FreeValue, Sensitivity
from thincam_jax.reconstruction.result import Reconstruction

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def closed():
    from matplotlib import pyplot

    yield
    pyplot.close("all")


@pytest.mark.thorough
def test_a_history_shows_what_the_solver_noted():
    random = np.random.default_rng(0)
    recording = tc.Recording(
        random.uniform(size=(1, 12, 16)), Psfs(random.uniform(size=(1, 12, 16)))
    )
    result = tc.reconstruct(recording, tc.AdmmTV(2.0, iterations=20))
    objective, residuals = tc.plot.history(result).axes
    noted = [(entry.iteration, entry.objective) for entry in result.history]
    np.testing.assert_allclose(objective.lines[0].get_xydata(), noted)
    assert [line.get_label() for line in residuals.lines] == ["primal", "dual"]
    closed_form = Reconstruction(jnp.zeros((3, 4)), None, method="wiener")
    with pytest.raises(ValueError, match="by wiener has no iterations; give the result of an iter"):
        tc.plot.history(closed_form)


def test_a_landscape_marks_its_minimum():
    across, down = np.linspace(10, 30, 7), np.linspace(5, 15, 4)
    values = (across - 20) ** 2 + (down[:, None] - 5) ** 2
    labels = ("β₁ (rad/mm²)", "β₂ (rad/mm²)", "error (dB)")
    figure = tc.plot.landscape(values, across, down, labels=labels)
    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == labels
    cross = next(line for line in axes.lines if line.get_marker() == "x")
    np.testing.assert_allclose(cross.get_xydata(), [[20, 5]])
    for wrong in (values.T, np.full_like(values, np.nan)):
        with pytest.raises(ValueError, match=r"give finite values of shape \(4, 7\)"):
            tc.plot.landscape(wrong, across, down, labels=labels)


def test_a_front_tells_dominated_points_apart():
    worth = ((2.0, 10.0, 0.3), (3.0, 12.0, 0.2), (4.0, 11.0, 0.1))
    points = [FrontPoint(cost, small.pairs(), limit, "", error) for cost, limit, error in worth]
    left, right = tc.plot.front(points, "thickness (mm)").axes
    assert (left.get_xlabel(), right.get_xlabel()) == ("thickness (mm)",) * 2
    np.testing.assert_array_equal(left.lines[1].get_xydata(), [[2, 10], [3, 12]])
    np.testing.assert_array_equal(left.lines[2].get_xydata(), [[4, 11]])
    assert left.lines[2].get_markerfacecolor() == "white"
    assert len(right.lines[1].get_xydata()) == 3


def test_tolerances_as_parts_of_their_numbers():
    values = (FreeValue("beta", (1,), 20.0, 0.5), FreeValue("width", (), 2.0, None))
    near = Derivatives(np.zeros(2), np.ones(2))
    (axes,) = tc.plot.sensitivity(Sensitivity(values, near, 0.01)).axes
    assert [bar.get_width() for bar in axes.patches] == [2.5, pytest.approx(np.nan, nan_ok=True)]
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "β of shot 1, rad/mm²\n20.00 (±0.5)",
        "mask width, mm\n2.00",
    ]
