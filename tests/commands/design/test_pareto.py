"""Fronts of thickness, captures and light: what costs more is never worse, and what is divided."""

import inspect
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands.design import tiny
from commands.study.tiny import Told

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import pareto
from thincam_jax.commands.design import problem as problem_of_search
from thincam_jax.commands.design.config_pareto import with_shots
from thincam_jax.commands.design.figures import as_png, draw_fronts
from thincam_jax.commands.design.page import fronts as tables
from thincam_jax.commands.design.pareto import Front, FrontPoint, Fronts, FrontSearches
from thincam_jax.commands.design.problem import build_problem
from thincam_jax.commands.design.record import record_fronts
from thincam_jax.commands.run_folder import carry_out
from thincam_jax.design import find_designs, landscape
from thincam_jax.design.search import Found, Search

FREE = (
    "search.free=[{variable: beta, bounds: [12 rad/mm^2, 30 rad/mm^2]}, "
    "{variable: distance, bounds: [2 mm, 3 mm], shared: true}]"
)
LIGHT = "noise={read_noise: 4, electrons: 900}"
THICKNESS = "pareto.thickness={bounds: [2 mm, 3 mm], points: 3}"


def by_grid(goal, space, data, **options):
    """In place of the search, which takes long to compile: the best points of a grid."""
    inspect.signature(find_designs).bind(goal, space, data, **options)
    points, values = landscape(goal, space, data, 3)
    best = [points[n] for n in np.argsort(values)[:3]]
    found = (Found(space.design(p), space.values(p), 0.0, "converged", (), p) for p in best)
    return Search(tuple(found), len(points), 0)


@pytest.fixture
def on_a_grid(monkeypatch):
    monkeypatch.setattr(problem_of_search, "find_designs", by_grid)


def find_fronts(study, told=tiny.ignore):
    searches = FrontSearches(study, study.config.pareto)
    carry_out(searches.work, told)
    return searches.result()


def rising(values):
    return all(b >= a for a, b in zip(values, values[1:], strict=False))


@pytest.mark.thorough
def test_thickness_and_light_buy_resolution(on_a_grid, tmp_path):
    light = "pareto.light={bounds: [90, 9e5], points: 3}"
    told = Told()
    found = find_fronts(tiny.built(tmp_path, FREE, LIGHT, THICKNESS, light), told)
    assert len(told) == told.total == 14
    assert list(found.fronts) == ["thickness", "light"]
    assert found.edge == pytest.approx(3.0 * 12.5 / 2)
    thickness, light = (front.points for front in found.fronts.values())
    assert [p.cost for p in thickness] == pytest.approx([2.0, 2.5, 3.0])
    assert [p.cost for p in light] == pytest.approx([90, 9e3, 9e5])
    for points in (thickness, light):
        values = [p.resolution for p in points]
        assert rising(values)
        assert values[-1] > values[0] > 0
    for point in thickness:
        assert all(2.0 <= shot.distance <= point.cost + 1e-9 for shot in point.shots)
        assert all(12 <= shot.beta <= 30 for shot in point.shots)
    # No less than the design to beat, which is a design at 3 mm and 900 electrons.
    references = [front.reference for front in found.fronts.values()]
    assert thickness[-1].resolution >= 0.9 * references[0].resolution
    assert references[0].resolution == references[1].resolution
    assert [reference.cost for reference in references] == [3.0, 900.0]


def test_what_costs_more_is_never_worse_for_want_of_searching(tmp_path, monkeypatch):
    """Only one of the searches finds the best β, of the middle cost: 21 for both shots."""
    searched = []

    def lucky_once(goal, space, data, **options):
        searched.append(space)
        point = jnp.full(3, 0.5 if len(searched) == 2 else 0.0)
        found = Found(space.design(point), space.values(point), 0.0, "converged", (), point)
        return Search((found,), 1, 0)

    def judged(design, data):
        off = jnp.abs(design.beta[0] - 21.0) + jnp.abs(design.beta[2] - 21.0)
        return 10.0 - off / 9, jnp.asarray(0.1)

    monkeypatch.setattr(problem_of_search, "find_designs", lucky_once)
    monkeypatch.setattr(pareto, "_exactly", judged)
    points = find_fronts(tiny.built(tmp_path, FREE, THICKNESS)).fronts["thickness"].points
    # The thinner one, too, has the same β, at the distance that it is allowed.
    assert [p.resolution for p in points] == pytest.approx([10.0] * 3)
    assert [p.shots[0].distance for p in points] == pytest.approx([2.0, 2.25, 2.25])
    assert len(searched) == 3 + 2 + 2


@pytest.mark.thorough
def test_fronts_by_search(tmp_path):
    """With the search itself: no worse than the grid's, and the PSNR is that of a simulation."""
    quick = ("pareto.samples=16", "pareto.starts=2", "pareto.steps=8")
    asked = (FREE, LIGHT, THICKNESS, "pareto.captures.shots=[1, 2]", *quick)
    fronts = find_fronts(tiny.built(tmp_path, *asked)).fronts
    assert rising([p.resolution for p in fronts["thickness"].points])
    one, two = fronts["captures"].points
    assert (one.cost, two.cost) == (2, 4)
    assert two.error < one.error
    assert 10 < dict(two.simulated)["picture"] < 60


def exposed(study, count):
    """Error and resolution of copies of the reference's first shot, seen by an endless sensor."""
    problem, config = build_problem(study), study.config
    given = pareto._of_shots(with_shots(config, 1), problem, count)
    divided = config.noise.electrons is not None
    np.testing.assert_allclose(given.space.base.exposure, 2 / count if divided else 1.0)
    setup = eqx.tree_at(lambda s: s.sensor_width, given.data.setup, jnp.asarray(50.0))
    # Rings are compiled faster than the exact response.
    return float(pareto._exactly(given.space.base, replace(given.data, setup=setup))[1])


def test_captures_share_the_exposure(tmp_path):
    """Two halves of an exposure are a whole one, but for the read noise of each."""
    errors = {}
    for name, noise in (("none", 0), ("some", 100)):
        study = tiny.built(tmp_path, f"noise={{read_noise: {noise}, electrons: 9000}}")
        errors[name] = [exposed(study, count) for count in (1, 2)]
    assert errors["none"][1] == pytest.approx(errors["none"][0], rel=1e-9)
    assert errors["some"][1] > 1.01 * errors["some"][0]
    # As many captures as the reference takes have the electrons of the file each.
    study = tiny.built(tmp_path, LIGHT, "pareto.captures.shots=[2]")
    problem = build_problem(study)
    given = pareto._of_shots(study.config, problem, 2)
    for one, whole in ((given.data, problem.data), (given.exact, problem.exact)):
        counted = one.setup.noise.electrons * given.space.base.exposure
        np.testing.assert_allclose(counted, whole.setup.noise.electrons)


@pytest.mark.thorough
def test_at_an_snr_each_capture_is_as_good_as_alone(tmp_path):
    study = tiny.built(tmp_path)
    assert exposed(study, 2) < 0.9 * exposed(study, 1)


def test_captures_are_simulated_with_their_part_of_the_light(on_a_grid, tmp_path, monkeypatch):
    """Half the captures of the reference's four hold twice the electrons each."""
    asked = []

    def simulate(study, target, seeds):
        (method,) = study.methods
        asked.append((method.exposures[0].relative_time, target.number, target.name, seeds))
        assert study.sensor.electrons == study.config.noise.electrons
        return {method.name: [{"psnr_db": 20.0 + len(asked)}]}

    best = []

    def judged(self, problem, near, own):
        best.append((problem.space.base.captures, near))
        return FrontPoint(0.0, problem.space.base, 9.0, "", 0.1 / len(best))

    monkeypatch.setattr(pareto, "simulate", simulate)
    monkeypatch.setattr(FrontSearches, "_best", judged)
    monkeypatch.setattr(pareto, "_judge", lambda base, _: FrontPoint(0.0, base, 1.0, "", 0.2))
    told = Told()
    captures = ("pareto.captures.shots=[4, 1]", "search.limits.captures=8")
    front = find_fronts(tiny.built(tmp_path, LIGHT, *captures), told).fronts["captures"]
    assert len(told) == told.total == 4
    assert asked == [(2.0, 1, "picture", 1), (0.5, 1, "picture", 1)]
    assert [p.simulated for p in front.points] == [(("picture", v),) for v in (21, 22)]
    assert front.reference.cost == 4
    assert [len(p.shots) for p in front.points] == [1, 4]
    # A search for more begins at the best of fewer, its last shot taken again.
    (few, none), (many, before) = best
    assert (few, none, many) == (2, None, 8)
    np.testing.assert_allclose(before.beta, [25.0] * 8)
    assert before.exposure[0] == pytest.approx(4 / 8)


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


def test_resolution_ends_where_frequencies_or_pixels_do(tmp_path, monkeypatch):
    problem, edge = build_problem(tiny.built(tmp_path)), 3.0 * 12.5 / 2
    for found, distance, resolution, ends in (
        (edge, 3.0, edge, "at the band's end"),
        (np.inf, 3.0, edge, "at the band's end"),
        (edge, 1.0, 12.5, "at the pixels' Nyquist frequency"),
        (7.0, 1.0, 7.0, ""),
    ):
        values = (jnp.asarray(found), jnp.asarray(0.1))
        monkeypatch.setattr(pareto, "_exactly", lambda *_, values=values: values)
        near = eqx.tree_at(lambda d: d.distance, problem.space.base, jnp.full(4, distance))
        judged = pareto._judge(near, problem.exact)
        assert judged.resolution == pytest.approx(resolution)
        assert judged.ends == ends


def test_near_a_place_mask_pixels_hold(tmp_path):
    """β·width ≤ π/pixel in all of the neighbourhood, which has the place itself in it."""
    config = tiny.design(
        tmp_path,
        "search.free=[{variable: beta, bounds: [5 rad/mm^2, 60 rad/mm^2], shared: true}, "
        "{variable: width, bounds: [1 mm, 2.5 mm]}]",
        "search.limits.mask_pixel=50 um",
    )
    space = config.space()
    corners = jnp.asarray([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
    for place in ([0.5, 1.0], [0.1, 0.4], [1.0, 0.9]):
        near = pareto._near(space, jnp.asarray(place))
        inside = np.asarray(near.point(space.design(jnp.asarray(place))))
        assert np.all((inside >= -1e-9) & (inside <= 1 + 1e-9))
        designs = jax.vmap(near.design)(corners)
        assert np.all(designs.beta[:, 0] * designs.width <= np.pi / 0.05 * (1 + 1e-9))
        assert np.all(near.upper > near.lower)


def test_an_objective_that_is_nan_is_refused():
    bad = FrontPoint(np.nan, tiny.found([25.0]), np.nan, "", np.nan)
    with pytest.raises(ConfigError, match="NaN at any start"):
        pareto._known([bad])
    good = replace(bad, error=0.1)
    (kept,) = pareto._known([bad, good])
    assert kept is good


def hand_made():
    """Fronts with a point of each sort."""

    def point(cost, resolution, error=0.1, ends="", simulated=()):
        return FrontPoint(cost, tiny.found([20.0, 20.0]), resolution, ends, error, simulated)

    lines = (point(2.0, 10.0), point(2.5, 12.0), point(3.0, 12.0), point(4.0, 18.75, ends="at it"))
    captures = (
        point(2.0, 9.0, 0.1, "", (("picture", 24.0),)),
        point(4.0, 9.0, 0.05, "", (("picture", 23.0),)),
        point(6.0, 9.0, 0.06, "", (("picture", None),)),
    )
    reference = point(3.0, 11.0, 0.08)
    line = Front(lines, reference)
    front = Front(captures, replace(reference, cost=4.0))
    return Fronts({"thickness": line, "captures": front, "light": line}, 18.75, 0.04)


def test_record_figure_and_tables(tmp_path):
    config = tiny.design(tmp_path, LIGHT)
    told = record_fronts(config, hand_made())
    points = told["thickness"]["points"]
    assert [p["dominated"] for p in points] == [False, False, True, False]
    assert [p["resolution_ends"] for p in points] == [None] * 3 + ["at it"]
    assert points[0]["resolution_line_pairs_per_mm"] == pytest.approx(10.0 / 100)
    captures = told["captures"]["points"]
    assert captures[0]["predicted_psnr_db"] == pytest.approx(-10 * np.log10(0.1 * 0.04), rel=1e-6)
    assert [p["dominated"] for p in captures] == [False, False, True]
    assert [p["simulated_dominated"] for p in captures] == [False, True, True]
    assert captures[2]["simulated_mean_db"] is None
    assert "divided" in told["captures"]["exposure"]
    assert "SNR" in record_fronts(tiny.design(tmp_path), hand_made())["captures"]["exposure"]
    figure = draw_fronts(told, "pairs", 100.0)
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
    assert as_png(figure).startswith(b"\x89PNG")
    named = tables({"pareto": told, "reference": {"name": "pairs"}})
    assert [len(table["rows"]) for table in named] == [5, 4, 5]
    assert named[0]["rows"][2][-1] == "no"
    assert named[0]["rows"][-1][0] == "pairs: 3"
    assert named[1]["rows"][2][-2:] == ["–", "no"]
    assert all(len(row) == len(table["labels"]) for table in named for row in table["rows"])
    alone = draw_fronts({"light": told["light"]}, "pairs", 100.0)
    assert len(alone.axes) == 1
