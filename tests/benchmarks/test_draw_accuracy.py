"""The figure and the costs of the benchmark of accuracy, on results made up for it."""

import json
import runpy

import pytest
from commands.study import tiny

from helpers import ROOT

FIGURE = runpy.run_path(str(ROOT / "benchmarks/draw_accuracy.py"))


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
