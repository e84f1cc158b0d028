"""Pictures through a calibrated screen: calibrate, capture, reconstruct, by the commands."""

import json
import os
import shutil

import numpy as np
import pytest
import skimage.io
import yaml
from commands.pages import assert_says_its_result
from commands.test_cli import call, called, one_line
from hardware.commands import tiny

PICTURES = yaml.safe_load(tiny.HADAMARD) | {
    "name": "tiny-pictures",
    "plan": {"kind": "pictures", "cells": [8, 16], "frames": 2, "dark_frames": 2},
    "matrix": "calibration.zarr",
    "methods": [{"name": "CGM", "kind": "ridge"}, {"name": "TV", "kind": "admm_tv"}],
    "targets": [
        {"name": "bars", "kind": "file", "path": "bars.png"},
        {"name": "turned", "kind": "file", "path": "bars.png", "width": 0.6, "rotation": "90 deg"},
    ],
}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder with the captures of a calibration and of two pictures."""
    folder = tmp_path_factory.mktemp("pictures")
    before = os.getcwd()
    os.chdir(folder)
    bars = np.zeros((8, 16), np.uint8)
    bars[2:6, 3:7], bars[1:7, 11] = 250, 120
    skimage.io.imsave(folder / "bars.png", bars, check_contrast=False)
    for name, raw in (("calibration", yaml.safe_load(tiny.HADAMARD)), ("pictures", PICTURES)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(raw), "utf-8")
        result = called("capture", f"{name}.yaml", "--out", f"{name}.zarr")
    assert "6 frames; next: thincam run" in result.stdout.replace("\n", "")
    yield folder
    os.chdir(before)


@pytest.mark.thorough
def test_pictures_come_back(home):
    """By the captures of the calibration, and by the matrix that their own run made."""
    called("run", "pictures.zarr", "--out", "found")
    scores = json.loads((home / "found/metrics.json").read_text("utf-8"))["methods"]
    for method in ("CGM", "TV"):
        of_targets = scores[method]["targets"]
        assert of_targets["bars"]["psnr_db"] > 22
        assert of_targets["turned"]["psnr_db"] > 22
    image = skimage.io.imread(home / "found/images/bars--tv.png")
    assert image[3, 4] > image[3, 11] > image[0, 0]
    page = assert_says_its_result(home / "found")
    assert "Beside what was published" in page and "turned" in page
    again = call("run", "pictures.zarr", "--out", "again", "--set", "matrix=found/matrix.zarr")
    assert again.exit_code != 0  # a store has its own file
    text = (home / "pictures.zarr/config.yaml").read_text("utf-8")
    assert "calibration.zarr" in text
    other = home / "other.zarr"
    shutil.copytree(home / "pictures.zarr", other)
    (other / "config.yaml").write_text(
        text.replace("calibration.zarr", "found/matrix.zarr"), "utf-8"
    )
    assert call("run", "other.zarr", "--out", "again").exit_code == 0
    there = json.loads((home / "again/metrics.json").read_text("utf-8"))["methods"]
    assert there["TV"]["targets"] == scores["TV"]["targets"]


@pytest.mark.thorough
def test_dark_frames_subtract_the_light_of_a_display(home):
    """A display behind the plate shines on, in every frame: one without a scene has only it."""
    scores = {}
    screen = yaml.safe_load(tiny.HADAMARD + tiny.DISPLAY_LIGHT)["virtual"]
    for darks in (8, 0):
        plan = PICTURES["plan"] | {"dark_frames": darks}
        raw = PICTURES | {"name": f"lit-{darks}", "plan": plan, "virtual": screen}
        (home / "lit.yaml").write_text(yaml.safe_dump(raw), "utf-8")
        store, out = f"lit-{darks}.zarr", f"lit-{darks}"
        for args in (("capture", "lit.yaml"), ("run", store)):
            called(*args, "--out", store if args[0] == "capture" else out)
        found = json.loads((home / out / "metrics.json").read_text("utf-8"))["methods"]
        scores[darks] = found["CGM"]["mean_psnr_db"]
    assert scores[8] > 22 and scores[8] > scores[0] + 5, scores


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        (
            "virtual.screen.display_light={leak: [[400 nm, 0.1], [700 nm, 0.1]], "
            "primaries: [{centre: 530 nm, width: 60 nm}], path: lost.tif}",
            "virtual.screen.display_light.path: lost.tif",
        ),
        ("matrix=null", "matrix: a plan of kind pictures needs it"),
        ("targets=[]", "targets: a plan of kind pictures needs them"),
        ("plan={kind: scene}", "targets: a plan of kind scene has one; drop the others"),
        ("plan.kind=hadamard", "plan.frames: a plan of kind hadamard takes cells, order, display"),
        ("virtual.screen.object.cells=[8, 8]", "virtual.screen.object.cells: the plan shows"),
    ],
)
def test_files_that_do_not_fit(home, asked, line):
    assert line in one_line(call("capture", "pictures.yaml", "--out", "x.zarr", "--set", asked))


@pytest.mark.thorough
def test_a_scene_comes_back_by_the_matrix(home):
    """Two exposures merged, weighed by their variance; a real one has nothing to compare with."""
    plan = {"kind": "scene", "exposures": ["10 ms", "40 ms"], "frames": 3, "dark_frames": 2}
    raw = PICTURES | {"name": "tiny-scene", "plan": plan, "targets": PICTURES["targets"][:1]}
    (home / "scene.yaml").write_text(yaml.safe_dump(raw), "utf-8")
    for args in (("capture", "scene.yaml", "--out", "scene.zarr"), ("run", "scene.zarr")):
        called(*args, *(("--out", "seen") if args[0] == "run" else ()))
    metrics = json.loads((home / "seen/metrics.json").read_text("utf-8"))["methods"]
    assert all(metrics[name]["targets"]["bars"]["psnr_db"] > 35 for name in ("CGM", "TV"))
    assert "reconstructs 1 picture at" in assert_says_its_result(home / "seen")
    shutil.copytree(home / "scene.zarr", home / "real.zarr")
    text = (home / "scene.zarr/config.yaml").read_text("utf-8")
    real = text.replace("rig: virtual", "rig: real").replace("sdl", "shutter")
    (home / "real.zarr/config.yaml").write_text(real, "utf-8")
    called("run", "real.zarr", "--out", "real")
    scores = json.loads((home / "real/metrics.json").read_text("utf-8"))["methods"]["TV"]
    assert scores["mean_psnr_db"] is None and not scores["targets"]
    images = [
        skimage.io.imread(home / path)
        for path in ("seen/images/bars--tv.png", "real/images/scene--tv.png")
    ]
    np.testing.assert_array_equal(*images)
