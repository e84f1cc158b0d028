"""Marks on a monitor before a lensless camera, by the commands, and pictures placed by them."""

import json

import numpy as np
import pytest
import yaml
from commands.test_cli import call, one_line
from hardware.commands import tiny

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.study.build import picture
from thincam_jax.hardware.commands.config import CaptureConfig
from thincam_jax.hardware.commands.run import build_study, picture_levels
from thincam_jax.hardware.virtual.optics import MonitorPose, cells_seen
from thincam_jax.measured.calibration.alignment import Alignment
from thincam_jax.units import deg

MASK = {"betas": ["60 rad/mm^2"], "width": "1.44 mm"}
POSE = {"x": "2 mm", "y": "-1.5 mm", "z": "2 mm", "rotation": "3 deg", "turn": "6 deg"}
ALIGNMENT = yaml.safe_load(tiny.METHOD_B) | {
    "camera": {"driver": "usb3_vision", "exposure": "500 ms", "pitch": "22 um"},
    "display": {"driver": "sdl", "pitch": "0.5 mm", "settle": "1 ms"},
    "plan": {"kind": "alignment", "marks": [3, 3], "spread": "20 mm", "size": "3 mm"} | MASK,
    "targets": [],
}
ALIGNMENT["plan"] |= {"map": "homography", "dark_frames": 1}
ALIGNMENT["optics"] |= {"object": {"distance": "250 mm", "width": "40 mm"}}
ALIGNMENT["virtual"] |= {"sensor": [96, 112], "monitor": POSE, "read_noise": 1.0}
PICTURES = {"kind": "pictures", "cells": [16, 16]} | MASK


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("alignment"), yaml.safe_dump(ALIGNMENT))


def pictures(alignment):
    sets = f"plan={json.dumps(PICTURES)}", f"alignment={alignment}", "camera.exposure=20 ms"
    target = "targets=[{name: coins, kind: photograph, image: coins}]"
    return [part for one in (*sets, target) for part in ("--set", one)]


@pytest.mark.thorough
def test_the_monitor_is_found_and_pictures_are_shown_in_place(file):
    """To a tenth of a pixel of the display; pictures are seen where the model has them."""
    store, out = file.with_name("a.zarr"), file.with_name("out")
    for args in (("capture", file, "--out", store), ("run", store, "--out", out)):
        result = call(*args)
        assert result.exit_code == 0, result.output
    found = Alignment.load(out / "alignment.json")
    assert found.used == 9
    angles = {"rotation": 3 * deg, "turn": 6 * deg}
    matrix = MonitorPose(x=2.0, y=-1.5, z=2.0, **angles).homography(250.0)
    corners = np.array([[x, y, 1.0] for x in (-10.0, 10.0) for y in (-10.0, 10.0)])
    true = corners @ matrix.T
    missed = found(corners[:, :2]) - true[:, :2] / true[:, 2:]
    assert np.abs(missed).max() < 0.1 * 0.5
    assert "9 of 9 marks lie within" in (out / "report.html").read_text("utf-8")
    store, placed = file.with_name("b.zarr"), out / "alignment.json"
    for args in (("capture", file, "--out", store, *pictures(placed)), ("run", store)):
        result = call(*args, *(() if args[0] == "capture" else ("--out", file.with_name("b"))))
        assert result.exit_code == 0, result.output
    config = load_as(CaptureConfig, store / "config.yaml")
    (levels,) = picture_levels(config).values()
    (target,), to_cells = config.targets, np.diag([1 / 2.5, 1 / 2.5, 1.0])
    (scene,) = build_study(config, (96, 112)).targets  # what is compared is what was shown
    np.testing.assert_allclose(scene.plane.image[0], picture(target, (16, 16)), atol=1e-6)
    wanted, inner = picture(target, (16, 16)), slice(4, 12)  # the display is not as high
    for pose, least, most in (matrix, 0.98, 1.0), (np.eye(3), -1.0, 0.7):
        seen = cells_seen(levels, (16, 16), to_cells @ pose @ np.diag([0.5, 0.5, 1.0]))
        alike = np.corrcoef(seen[inner, inner].ravel(), wanted[inner, inner].ravel())[0, 1]
        assert least < alike <= most


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        (["plan.spread=60 mm"], "plan.spread: a mark of 3 mm at -30, -30 mm is not all on the"),
        (["plan.size=null"], "plan.size: a plan of kind alignment needs it"),
        (["optics=null"], "optics: a plan of kind alignment needs optics"),
        (["alignment=a.json"], "alignment: a plan of kind alignment takes none; drop it"),
        ([f"plan={json.dumps(PICTURES)}"], "alignment: a plan of kind pictures with optics"),
        (["plan.betas=[60 rad/mm^2, 50 rad/mm^2]"], "plan.betas: a plan of kind alignment has one"),
    ],
)
def test_files_that_do_not_fit(file, asked, line):
    assert line in one_line(call("capture", file, *(part for a in asked for part in ("--set", a))))


def test_an_alignment_that_cannot_be_read(file):
    line = one_line(call("capture", file, *pictures("none.json")))
    assert "none.json" in line
