"""Record, figure and tables of fronts; the reference's broken limits."""

import dataclasses

import numpy as np
import pytest
from commands.design import tiny

from thincam_jax.commands.design.figures import as_png, draw_fronts
from thincam_jax.commands.design.record import Front, Fronts, broken_limits, record_fronts
from thincam_jax.commands.design.report import fronts
from thincam_jax.design import FrontPoint

LIGHT = "noise={read_noise: 4, electrons: 900}"


def test_limits_that_the_reference_breaks(tmp_path):
    """π / (0.08 mm · 2 mm) = 19.6 rad/mm²."""
    config = tiny.design(tmp_path, "search.limits.mask_pixel=80 um")
    assert [why[:12] for why in broken_limits(config)] == ["β of shot 1,", "β of shot 2,"]
    free = "search.free=[{variable: distance, bounds: [2 mm, 3 mm]}]"
    assert len(broken_limits(tiny.design(tmp_path, free, "search.limits.thickness=2 mm"))) == 2


def hand_made():
    """Fronts with a point of each sort."""

    def point(cost, resolution, error=0.1, ends=""):
        return FrontPoint(cost, tiny.found([20.0, 20.0]), resolution, ends, error)

    lines = (point(2.0, 10.0), point(2.5, 12.0), point(3.0, 12.0), point(4.0, 18.75, ends="at it"))
    captures = (point(2.0, 9.0, 0.1), point(4.0, 9.0, 0.05), point(6.0, 9.0, 0.06))
    simulated = tuple((("picture", level),) for level in (24.0, 23.0, None))
    reference = point(3.0, 11.0, 0.08)
    line = Front(lines, reference)
    front = Front(captures, dataclasses.replace(reference, cost=4.0))
    return Fronts({"thickness": line, "captures": front, "light": line}, 18.75, 0.04, simulated)


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
    named = fronts({"pareto": told, "reference": {"name": "pairs"}})[::2]
    assert [len(table.rows) for table in named] == [5, 4, 5]
    assert named[0].rows[2][-1] == "no"
    assert named[0].rows[-1][0] == "pairs: 3"
    assert named[1].rows[2][-2:] == ["–", "no"]
    alone = draw_fronts({"light": told["light"]}, "pairs", 100.0)
    assert len(alone.axes) == 1
