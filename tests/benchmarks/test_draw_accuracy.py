"""The figure and the costs of the benchmark of accuracy, on results made up for it."""

import runpy

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
