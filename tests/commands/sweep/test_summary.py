"""The summary of a sweep: where the PSNR is best, and how it goes along the axes."""

import pyarrow as pa
import pytest
import skimage.io

from thincam_jax.commands.sweep.run import summarise
from thincam_jax.plot.sweep import draw_sweep

AXES = ["methods.0.shots.0.beta", "model"]
COLUMN = "mean_psnr_db/single"


def rows():
    """Six points, of which one has no PSNR; best at β = 20 with the second model."""
    level = {(15.0, "a"): 20.0, (20.0, "a"): 22.0, (25.0, "a"): None}
    level |= {(15.0, "b"): 21.0, (20.0, "b"): 24.0, (25.0, "b"): 23.0}
    return [dict(zip(AXES, at, strict=True), **{COLUMN: psnr}) for at, psnr in level.items()]


def test_best_point_and_picture(tmp_path):
    best = summarise(tmp_path, pa.Table.from_pylist(rows()), AXES)
    place = "methods.0.shots.0.beta=20.0, model=b"
    assert best == (f"best mean PSNR of single: 24.00 dB at {place}",)
    assert skimage.io.imread(tmp_path / "summary.png").std() > 5


def test_lines_of_each_axis_and_a_map_of_two():
    first, second, around, *_ = draw_sweep(rows(), AXES, {"single": COLUMN}).axes
    (line, *_), *_ = first.containers
    assert line.get_xydata().tolist() == [[15, 20.5], [20, 23], [25, 23]]
    assert first.get_xlabel() == "methods.0.shots.0.beta (rad/mm²)"
    assert [t.get_text() for t in second.get_xticklabels()] == ["a", "b"]
    (mesh,) = around.collections
    assert mesh.get_array().filled(0).tolist() == [[20, 22, 0], [21, 24, 23]]


def test_no_map_of_a_method_that_an_axis_does_not_change():
    table = [row | {"mean_psnr_db/same": 10.0 + ord(row["model"])} for row in rows()]
    methods = {"single": COLUMN, "same": "mean_psnr_db/same"}
    assert [ax.get_title("left") for ax in draw_sweep(table, AXES, methods).axes[2:4]] == [
        "single",
        "",
    ]


@pytest.mark.parametrize("table", [{"seed": [1]}, {"seed": [1], COLUMN: [None]}])
def test_nothing_to_tell(tmp_path, table):
    assert summarise(tmp_path, pa.table(table), ["seed"]) == ()
    assert list(tmp_path.iterdir()) == []
