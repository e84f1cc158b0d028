"""The figure and the costs of the benchmark of accuracy, on results made up for it."""

import json
import runpy

import pytest
from commands.study import tiny
from matplotlib.figure import Figure

from helpers import ROOT

FIGURE = runpy.run_path(str(ROOT / "benchmarks/draw_accuracy.py"))


def test_the_reference_is_beside_the_measured_ones_and_not_among_them():
    """It has no error of its own: no place on that axis, and none on the joined line."""
    names = ("model", "precision", "oversampling", "shape", "status", "seconds", "true_error")
    table = [
        ("geometric", "float32", None, [48, 64], "run", 1e-3, 0.1),
        ("paraxial", "float32", None, [48, 64], "run", 2e-3, 0.01),
        ("separable", "float64", None, [48, 64], "run", 5e-3, 0.0),
    ]
    rows = [dict(zip(names, row, strict=True), worth_choosing=row[-1] > 0) for row in table]
    camera = {"beta_rad_per_mm2": 25.0, "distance_mm": 3.0}
    results = {
        "psfs": rows,
        "settings": {"camera": camera, "study": "tiny"},
        "machine": {"device_kind": "cpu", "cores": 2},
    }
    ax = Figure().subplots()
    FIGURE["_draw_times"](ax, results)
    *marks, joined, reference = ax.lines
    assert [tuple(mark.get_xydata()[0]) for mark in marks] == [(1e-3, 0.1), (2e-3, 0.01)]
    assert joined.get_xydata().tolist() == [[1e-3, 0.1], [2e-3, 0.01]]
    assert reference.get_xdata()[0] == 5e-3
    assert reference.get_transform() == ax.get_xaxis_transform()


def test_costs_have_a_line_for_each_psf_that_was_assumed():
    capture = {"psf_error": 0.1, "error": 1e-3, "contrast_error": 0.02}
    controlled = {"level": 0.01, "change": 1e-4, "psf_error": 0.01, "capture_error": 1e-4}
    controlled |= {"capture_contrast_error": 1e-3, "psnr_lost_db": -0.25}
    results = {
        "captures": [
            {"model": "geometric", "status": "run", **capture},
            {"model": "rayleigh_sommerfeld", "status": "not run", "reason": "slow"},
        ],
        "reconstructions": {
            "models": [{"model": "geometric", "status": "run", "psnr_lost_db": 0.5}],
            "controlled": [{"wrong": "beta", "status": "run", **controlled}],
        },
    }
    assert FIGURE["costs"](results)[2:] == [
        "| geometric | 1.0e-01 | 1.0e-03 | 2.0e-02 | 0.5000 |",
        "| exact, wrong β by 1.0e-04 | 1.0e-02 | 1.0e-04 | 1.0e-03 | −0.2500 |",
    ]


@pytest.mark.thorough
def test_a_measured_study_is_drawn(tmp_path, monkeypatch):
    """Errors count from the exact field, and losses from its reconstruction."""
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "benchmarks/accuracy.py"))["main"](str(tiny.write(tmp_path)), "32")
    (file,) = tmp_path.glob("runs/*/accuracy.json")
    results = json.loads(file.read_text("utf-8"))
    errors = {(row["model"], row["precision"]): row for row in results["psfs"]}
    assert errors["separable", "float64"]["true_error"] == 0
    assert 0 < errors["separable", "float32"]["true_error"] < 1e-4
    costs = results["reconstructions"]
    lost = {row["model"]: row.get("psnr_lost_db") for row in costs["models"]}
    assert abs(lost["separable"]) < 1e-3 < lost["geometric"]
    assert [row["level"] for row in costs["controlled"]] == 2 * [0.003, 0.01, 0.03, 0.1]
    for row in costs["controlled"]:
        assert abs(row["psf_error"] / row["level"] - 1) < 0.05
    assert len(FIGURE["draw"](results).axes) == 3
