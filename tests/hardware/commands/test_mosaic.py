"""Masks side by side by the commands, on the virtual rig: one frame, split and reconstructed."""

import json

import numpy as np
import pytest
import yaml
from commands.test_cli import call, called, one_line
from hardware.commands import tiny

from thincam_jax.hardware.acquisition.read import Acquisition

MOSAIC = yaml.safe_load(tiny.METHOD_B)
MOSAIC["plan"] |= {
    "width": "0.864 mm",  # 24 pixels of the display, 28 apart
    "mosaic": {"rows": 2, "columns": 2, "pitch": "1.008 mm", "wall": "0.1 mm"},
}
MOSAIC["optics"]["object"]["width"] = "30 mm"


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # where held devices are noted
    return tiny.write(tmp_path, yaml.safe_dump(MOSAIC))


@pytest.mark.parametrize("wall", ["0.1 mm", pytest.param("null", marks=pytest.mark.thorough)])
def test_one_frame_holds_all_captures(wall, file, tmp_path):
    """The rig's optics know pixels and walls, not parts; what differs is noise."""
    store, out = tmp_path / "a.zarr", tmp_path / "out"
    options = ["--set", f"plan.mosaic.wall={wall}", "--set", "virtual.electrons=500_000"]
    for args in (("capture", file, "--out", store, *options), ("run", store, "--out", out)):
        called(*args)
    taken = Acquisition.load(store)
    (frame,) = taken.captures()
    assert [pattern.kind for pattern in taken.patterns] == ["mosaic"]
    under_the_wall = np.abs(np.asarray(frame)[:, 47:49].mean())
    assert (under_the_wall < 5) == (wall != "null")
    found = json.loads((out / "metrics.json").read_text("utf-8"))
    (residual,) = found["agreement"]["frame_residual_over_noise"]
    # 64·96 pixels: 0.01. Without walls 8 bits and few points a pixel leave a little.
    assert abs(residual - 1) < (0.04 if wall != "null" else 0.2)
    assert abs(found["psnr_db"]["captured"] - found["psnr_db"]["simulated"]) < 2.5


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("plan.mosaic.columns=3", "plan.mosaic: 4 masks are shown; give as many rows × columns"),
        ("plan.mosaic.pitch=1.02 mm", "give a width and a mosaic.pitch that are an even number"),
        ("camera.region={top: 4, left: 8, height: 48, width: 80}", "camera.region: a mosaic has"),
        ("plan.kind=scene", "plan.mosaic: a plan of kind scene takes "),
    ],
)
def test_faults_are_told_with_what_mends_them(asked, line, file, tmp_path):
    result = call("capture", file, "--set", asked, "--out", tmp_path / "a.zarr")
    assert line in one_line(result)
