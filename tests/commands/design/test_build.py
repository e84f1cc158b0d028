"""From a design's file to its search problem."""

import dataclasses

import numpy as np
import pytest
from commands.design import tiny

from thincam_jax.commands.design.build import front_problems, with_shots
from thincam_jax.design.objectives import ResolutionLimit, RobustError, Tolerances, WorstRatio

LIGHT = "noise={read_noise: 4, electrons: 900}"


def test_measured_prior_and_photon_noise(tmp_path):
    setup = tiny.built(tmp_path, "prior={measured: true}", LIGHT).problem.data.setup
    assert 2.6 < float(setup.prior.exponent) < 9  # smooth blobs fall off faster than photographs
    assert (float(setup.noise.electrons), float(setup.noise.read_noise)) == (900, 4)


@pytest.mark.parametrize("kind", ["wiener", "pnp"])
def test_designs_are_simulated_with_the_reconstruction_of_the_file(kind, tmp_path):
    study = tiny.built(tmp_path, f"validate.reconstruction={kind}")
    with_another = study.with_designs({"found": study.problem.space.base})
    assert [method.solver.name for method in with_another.methods] == [kind, kind]


def test_objectives_have_the_settings_of_the_file(tmp_path):
    asked = "search.tolerances={distance: 30 um, beta: 0.002}"
    robust = tiny.built(tmp_path, "search.objective=robust_error", asked).problem.objective
    assert isinstance(robust, RobustError) and robust.how == "mean"
    expected = dataclasses.astuple(Tolerances(beta=0.002, distance=0.03))
    assert dataclasses.astuple(robust.tolerances) == pytest.approx(expected)
    worst = "search.objective=worst_ratio"
    assert tiny.built(tmp_path, worst).problem.objective == WorstRatio()
    banded = tiny.built(tmp_path, worst, "search.band=[0.1, 0.4]")
    assert banded.problem.objective == WorstRatio((0.1, 0.4))


def test_problems_of_fronts(tmp_path):
    """Thickness and light buy resolution, on one band; captures share the exposure."""
    free = (
        "search.free=[{variable: beta, bounds: [12 rad/mm^2, 30 rad/mm^2]}, "
        "{variable: distance, bounds: [2 mm, 3 mm], shared: true}]"
    )
    study = tiny.built(tmp_path, free, LIGHT, "search.limits.captures=8")
    config, problem = study.study.config, study.problem
    thin = front_problems(config, problem, "thickness", [2.0, 3.0])
    assert [float(p.space.upper[-1]) for p in thin.values()] == [2.0, 3.0]
    lit = front_problems(config, problem, "light", [90.0])[90.0]
    assert float(lit.exact.setup.noise.electrons) == 90
    assert thin[2.0].objective == lit.objective == ResolutionLimit()
    captures = front_problems(config, problem, "captures", [2.0, 4.0, 8.0])
    assert [p.space.base.captures for p in captures.values()] == [2, 4, 8]
    assert [float(p.space.base.exposure[0]) for p in captures.values()] == [2.0, 1.0, 0.5]
    assert [p.data.synthesis.shape for p in captures.values()] == [(1, 2), (2, 4), (4, 8)]
    for one in (*thin.values(), lit, *captures.values()):
        np.testing.assert_array_equal(one.exact.frequencies.axis, problem.exact.frequencies.axis)


def test_further_shots_are_as_the_last(tmp_path):
    free = (
        "search.free=[{variable: beta, bounds: [12 /mm^2, 30 /mm^2], shots: [2]}, "
        "{variable: distance, bounds: [2 mm, 3 mm], shots: [1]}]"
    )
    config = tiny.design(tmp_path, free)
    more = with_shots(config, 4)
    assert [s.beta for s in more.reference.shots] == [25, 21, 21, 21]
    assert [f.shots for f in more.search.free] == [(2, 3, 4), (1,)]
    assert [f.variable for f in with_shots(config, 1).search.free] == ["distance"]
    assert with_shots(config, 2) == config
