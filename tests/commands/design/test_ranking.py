"""What surrounds a search: goals, ranking, tolerances, landscape."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from commands.design import tiny

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import problem as problem_of_search
from thincam_jax.commands.design import ranking
from thincam_jax.commands.design.problem import DesignObjective, build_problem
from thincam_jax.commands.design.ranking import Finder, distinct, rescored, tolerances
from thincam_jax.commands.design.record import broken_limits
from thincam_jax.commands.design.surroundings import landscape_of, least_change, shown, straight
from thincam_jax.commands.run_folder import carry_out
from thincam_jax.design import (
    Quadrant,
    Tolerances,
    bayes_error,
    channels,
    limit,
    robust_error,
    unevenness,
)
from thincam_jax.design.search import Found, Search


@dataclasses.dataclass(frozen=True)
class Bowl(DesignObjective):
    """1 + (β₁ − 20)² + 2 (β₂ − 15)² + d₁ of pairs; exactly with 0.3 (β₁ − 16)² more."""

    def __call__(self, design, data):
        first, second = design.beta[0], design.beta[2]
        value = 1 + (first - 20) ** 2 + 2 * (second - 15) ** 2 + design.distance[0]
        return value + (0.3 * (first - 16) ** 2 if isinstance(data.frequencies, Quadrant) else 0)


BOWL = Bowl("bayes_error")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return tiny.built(tmp_path_factory.mktemp("find"))


def bowl(study):
    """A problem whose objective is known in closed form."""
    return dataclasses.replace(build_problem(study), objective=BOWL)


def found_at(problem, *values) -> Found:
    space = problem.space
    point = (jnp.asarray(values) - space.lower) / (space.upper - space.lower)
    design = space.design(point)
    value = float(problem.objective(design, problem.data))
    return Found(design, space.values(point), value, "converged", ("a",), point)


@pytest.fixture
def scored(monkeypatch):
    """Scores by the objective alone: without responses there are no rings."""

    def score(problem, design):
        values = (float(problem.objective(design, data)) for data in (problem.data, problem.exact))
        return *values, np.ones(64)

    monkeypatch.setattr(ranking, "_score", score)


def test_the_setup_is_that_of_the_file(study):
    problem = build_problem(study)
    setup, frequencies = problem.exact.setup, problem.exact.frequencies
    synthesis = problem.exact.synthesis
    assert float(setup.sensor_width) == pytest.approx(48 * 0.04)  # the shorter side
    assert float(setup.noise.snr_db) == 30
    assert float(setup.prior.exponent) == 2.5
    assert not setup.pixel_integration
    assert synthesis.shape == (2, 4)
    # Half of the pixels' Nyquist frequency, 12.5 cycles/mm, at 3 mm.
    assert float(frequencies.highest) == pytest.approx(3.0 * 12.5 / 2)
    assert float(problem.data.frequencies.highest) == pytest.approx(3.0 * 12.5 / 2)


def test_measured_prior_and_photon_noise(tmp_path):
    noise = "noise={read_noise: 4, electrons: 900}"
    setup = build_problem(tiny.built(tmp_path, "prior={measured: true}", noise)).data.setup
    assert 2.6 < float(setup.prior.exponent) < 9  # smooth blobs fall off faster than photographs
    assert (float(setup.noise.electrons), float(setup.noise.read_noise)) == (900, 4)


def test_objectives_are_made_small_and_told_as_they_are(study):
    problem, band = build_problem(study), (0.1, 0.6)
    data, design = problem.data, problem.space.base
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    error, edge, uneven, ratio = (
        DesignObjective(name, band)
        for name in ("bayes_error", "limit", "unevenness", "worst_ratio")
    )
    value = float(error(design, data))
    assert value == pytest.approx(float(bayes_error(known)))
    assert error.told(value) == pytest.approx(10 * np.log10(value))
    assert error.gain(0.2, 0.1) == pytest.approx(3.0103, abs=1e-4)
    assert error.rise(0.2) == pytest.approx(0.002)
    value = float(edge(design, data))
    assert value == pytest.approx(-float(limit(known, data.frequencies)))
    expected = float(unevenness(known, data.frequencies, band))
    assert float(uneven(design, data)) == pytest.approx(expected)
    assert edge.told(value) == -value
    assert value < 0
    assert edge.gain(-10.0, -12.0) == pytest.approx(2.0)
    assert uneven.gain(3.0, 2.0) == pytest.approx(1.0)
    assert ratio.gain(-10.0, -12.0) == pytest.approx(2.0)
    assert ratio.rise(40.0) == pytest.approx(10 * np.log10(1.01), abs=1e-4)
    assert hash(error) == hash(DesignObjective("bayes_error", band))  # compiled once
    assert error == DesignObjective("bayes_error", band) != edge


def test_ranked_by_the_exact_value_and_orders_of_shots_are_one(study, scored):
    problem = bowl(study)
    betas = [(20.0, 15.0), (15.1, 19.9), (18.0, 15.0), (24.0, 15.0)]
    given = tuple(found_at(problem, *b) for b in betas)
    found = rescored(problem, distinct(problem.space, given))
    # Exactly: 4 + 4.8, 8 + 1.2, 20 + 19.2; 15.1, 19.9 is the first with its shots exchanged.
    assert [[s.beta for s in one.shots] for one in found] == [
        *(pytest.approx(b) for b in ((20, 15), (18, 15), (24, 15)))
    ]
    assert [one.exact for one in found] == pytest.approx([8.8, 9.2, 39.2])
    assert [one.searched for one in found] == pytest.approx([4, 8, 20])
    assert [one.name for one in found] == ["found 1", "found 2", "found 3"]
    assert found[0].active == ("a",)
    np.testing.assert_allclose(found[0].design.beta, [20, 20, 15, 15])
    second = rescored(problem, (found_at(problem, 18.0, 15.0), found_at(problem, 20.0, 15.0)))
    assert second[0].shots[0].beta == pytest.approx(20)  # the exact value counts


def test_tolerance_is_a_change_of_one_per_cent(study, scored):
    """Of the exact objective: 8.8 at (20, 15), with a slope of 2.4 and a curvature of 2.6."""
    problem = bowl(study)
    (one,) = rescored(problem, (found_at(problem, 20.0, 15.0),))
    first, second = one.values
    assert (first.variable, first.shots, second.shots) == ("beta", (1,), (2,))
    assert (first.value, second.value) == pytest.approx((20, 15))
    # 2.4 δ + 1.3 δ² = 0.088, and 2 δ² = 0.088.
    assert first.tolerance == pytest.approx((np.sqrt(2.4**2 + 5.2 * 0.088) - 2.4) / 2.6)
    assert second.tolerance == pytest.approx(np.sqrt(0.044))


WIDTH = (
    "search.free=[{variable: beta, bounds: [12 rad/mm^2, 30 rad/mm^2], shared: true}, "
    "{variable: width, bounds: [1 mm, 2.5 mm]}]",
    "reference.shots=[{beta: 15 rad/mm^2, distance: 3 mm}]",
)


@dataclasses.dataclass(frozen=True)
class Slope(DesignObjective):
    """1 + (β − 14)²/4 + 3 (width − 1.5)²."""

    def __call__(self, design, data):
        return 1 + (design.beta[0] - 14) ** 2 / 4 + 3 * (design.width - 1.5) ** 2


def test_the_tolerance_of_a_width_holds_beta(tmp_path):
    """Mask pixels tie β to the width in the search's cube, and not in a tolerance."""
    study = tiny.built(tmp_path, *WIDTH, "search.limits.mask_pixel=80 um")
    problem = dataclasses.replace(build_problem(study), objective=Slope("bayes_error"))
    finest = np.pi / 0.08 / 1.5
    point = jnp.asarray([(1.5 - 1) / 1.5, (14.0 - 12) / (finest - 12)])
    design, values = problem.space.design(point), problem.space.values(point)
    np.testing.assert_allclose(values, [1.5, 14.0])
    found = Found(design, values, 1.0, "converged", (), point)
    width, beta = tolerances(problem, found, 1.0)
    assert (width.variable, width.shots, beta.shots) == ("width", (), (1,))
    assert width.tolerance == pytest.approx(np.sqrt(0.01 / 3))
    assert beta.tolerance == pytest.approx(0.2)
    # Over both there is no rectangle to draw.
    around = landscape_of(problem.objective, problem.space, problem.data, design, 5)
    assert around.variables == (("beta", (1,)),)
    np.testing.assert_allclose(around.axes[0][-1], finest)
    np.testing.assert_allclose(around.values[-1], 1 + (finest - 14) ** 2 / 4)
    free = build_problem(tiny.built(tmp_path, *WIDTH))
    around = landscape_of(problem.objective, free.space, free.data, design, 5)
    assert around.variables == (("width", ()), ("beta", (1,)))


def test_straight_within_the_limits(tmp_path):
    """Its sides end where the search's do, at the width of the design."""
    config = tiny.design(
        tmp_path,
        "search.free=[{variable: beta, bounds: [12 rad/mm^2, 500 rad/mm^2]}, "
        "{variable: distance, bounds: [2 mm, 50 mm], shared: true}]",
        *("search.limits.mask_pixel=40 um", "search.limits.thickness=3 mm"),
    )
    space = config.space()
    alone, place, spans = straight(space, jnp.asarray([0.1, 0.5, 1.0]))
    np.testing.assert_allclose(spans, [np.pi / 0.04 / 2 - 12] * 2 + [1.0])
    np.testing.assert_allclose(place, [0.1, 0.5, 1.0], atol=1e-12)
    assert alone.limits.mask_pixel is None


def test_what_a_landscape_is_over(tmp_path):
    def names(*free):
        electrons = "noise={read_noise: 4, electrons: 900}"
        shots = ", ".join(f"{{beta: {b} /mm^2, distance: 3 mm}}" for b in (25, 21, 17, 15))
        given = ("search.limits.captures=8", f"reference.shots=[{shots}]", electrons)
        space = tiny.design(tmp_path, f"search.free=[{', '.join(free)}]", *given).space()
        return [v.name for v in shown(space)]

    width = "{variable: width, bounds: [1 mm, 2 mm]}"
    beta = "{variable: beta, bounds: [12 /mm^2, 30 /mm^2], shared: true}"
    one, two, three = (
        f"{{variable: exposure, bounds: [0.2, 1.2], shots: [{n}]}}" for n in (1, 2, 3)
    )
    assert names(width, beta, one) == ["beta", "exposure"]
    assert names(beta, one, two) == ["beta"]
    assert names(one, two) == ["exposure", "exposure"]
    assert names(width) == ["width"]
    assert names(one, two, three) == []


@pytest.mark.parametrize(
    ("slope", "curve", "rise", "change"),
    [(0.0, 2.0, 0.01, 0.1), (2.0, 0.0, 0.01, 0.005), (-3.0, 8.0, 1.0, 0.25)],
)
def test_change_that_costs_a_rise(slope, curve, rise, change):
    assert least_change(slope, curve, rise) == pytest.approx(change)


def robust_problem(folder):
    asked = "search.tolerances={distance: 30 um, beta: 0.002}"
    return build_problem(tiny.built(folder, "search.objective=robust_error", asked))


def test_tolerances_reach_the_goal(tmp_path):
    goal = robust_problem(tmp_path).objective
    assert (goal.name, goal.how) == ("robust_error", "mean")
    expected = Tolerances(beta=0.002, distance=0.03)
    found = dataclasses.astuple(goal.tolerances)
    assert found == pytest.approx(dataclasses.astuple(expected))
    assert goal != DesignObjective("robust_error")


@pytest.mark.thorough
def test_tolerances_cost_something(tmp_path):
    robust = robust_problem(tmp_path)
    base = robust.space.base
    exact = float(DesignObjective("bayes_error")(base, robust.data))
    found = float(robust.objective(base, robust.data))
    given = robust.data.setup, robust.data.synthesis, robust.data.frequencies
    expected = robust_error(base, *given, Tolerances(beta=0.002, distance=0.03))
    assert found == pytest.approx(float(expected), rel=1e-12)
    assert found > 1.001 * exact
    assert robust.objective.told(found) == pytest.approx(10 * np.log10(found))


def test_where_no_change_costs_anything():
    assert least_change(0.0, 0.0, 1.0) is None
    assert least_change(0.0, -1.0, 1.0) is None


def test_landscape_of_two_variables(study):
    problem = bowl(study)
    around = landscape_of(problem.objective, problem.space, problem.data, problem.space.base, 5)
    assert around.variables == (("beta", (1,)), ("beta", (2,)))
    np.testing.assert_allclose(around.axes, [[12, 16.5, 21, 25.5, 30]] * 2)
    assert around.values.shape == (5, 5)
    # Along the first axis the first variable: 1 + 3.5² + 2 · 10.5² + 3.
    assert around.values[1, 3] == pytest.approx(1 + 3.5**2 + 2 * 10.5**2 + 3)


def test_landscape_of_one_and_of_three_variables(tmp_path):
    """One is a line; of more, the first two, the others as in the best design."""
    one = "{variable: beta, bounds: [12 /mm^2, 30 /mm^2], shared: true}"
    moved = "reference.shots.1.distance=2.5 mm"
    problem = bowl(tiny.built(tmp_path, f"search.free=[{one}]", moved))
    line = landscape_of(problem.objective, problem.space, problem.data, problem.space.base, 3)
    assert line.variables == (("beta", (1, 2)),)
    np.testing.assert_allclose(
        line.values, [1 + (b - 20) ** 2 + 2 * (b - 15) ** 2 + 3 for b in (12, 21, 30)]
    )
    two = one.replace(", shared: true", "")
    distance = "{variable: distance, bounds: [2 mm, 3 mm], shared: true}"
    problem = bowl(tiny.built(tmp_path, f"search.free=[{two}, {distance}]"))
    best = found_at(problem, 20.0, 17.0, 2.2).design
    around = landscape_of(problem.objective, problem.space, problem.data, best, 3)
    assert around.values[0, -1] == pytest.approx(1 + 8**2 + 2 * 15**2 + 2.2)


def test_limits_narrow_the_landscape(tmp_path):
    """π / (0.08 mm · 2 mm) = 19.6 rad/mm²; at a thickness of 2 mm no room is left."""
    study = tiny.built(tmp_path, "search.limits.mask_pixel=80 um")
    problem = bowl(study)
    around = landscape_of(
        problem.objective, problem.space, problem.data, found_at(problem, 13.0, 13.0).design, 3
    )
    assert around.axes[0][-1] == pytest.approx(np.pi / 0.08 / 2)
    assert [why[:12] for why in broken_limits(study.config)] == ["β of shot 1,", "β of shot 2,"]
    study = tiny.built(
        tmp_path,
        "search.free=[{variable: distance, bounds: [2 mm, 3 mm]}]",
        "search.limits.thickness=2 mm",
    )
    problem = bowl(study)
    assert (
        landscape_of(problem.objective, problem.space, problem.data, problem.space.base, 3) is None
    )
    assert len(broken_limits(study.config)) == 2


def test_an_objective_that_is_nan_is_refused(study, monkeypatch):
    monkeypatch.setattr(problem_of_search, "find_designs", lambda *_, **__: Search((), 3, 3))
    with pytest.raises(ConfigError, match="NaN at any start"):
        carry_out(Finder(study).work, tiny.ignore)
