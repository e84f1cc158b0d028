"""Marks on a monitor before a lensless camera, by the commands, and pictures placed by them."""

import json

import numpy as np
import PIL.Image
import pytest
import scipy
import yaml
from commands.test_cli import call, called, one_line
from hardware.commands import tiny

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.study.build import picture
from thincam_jax.hardware.commands.config import CaptureConfig
from thincam_jax.hardware.commands.run import build_study, picture_levels
from thincam_jax.hardware.virtual.optics import MonitorPose, cells_seen
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.measured.calibration.alignment import Alignment
from thincam_jax.measured.layouts import open_pairs
from thincam_jax.units import deg

MASK = {"betas": ["60 rad/mm^2"], "width": "1.44 mm"}
POSE = {"x": "2 mm", "y": "-1.5 mm", "z": "2 mm", "rotation": "3 deg", "turn": "6 deg"}
ALIGNMENT = yaml.safe_load(tiny.METHOD_B) | {
    "camera": {"driver": "aravis", "exposure": "500 ms", "pitch": "22 um"},
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
        called(*args)
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
        called(*args, *(() if args[0] == "capture" else ("--out", file.with_name("b"))))
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


@pytest.fixture
def aligned(tmp_path):
    """A monitor that stands where the model has it, and a folder of two photographs."""
    known = np.array([1.0, 0.0, 0.0, 0.0]), 1e-8 * np.eye(4)
    Alignment((90, 100), 0.5, *known, 9, 9, 0.01).save(tmp_path / "alignment.json")
    (tmp_path / "photographs").mkdir()
    for name in ("coins", "chelsea"):
        photograph = resize(np.atleast_3d(sample_image(name)).mean(axis=-1), (32, 32))
        PIL.Image.fromarray(np.uint8(255 * photograph)).save(tmp_path / f"photographs/{name}.png")
    return tmp_path


def test_photographs_become_pairs_of_captures_and_truths(aligned):
    """Each truth, by the PSF of the folder, is the capture to the noise."""
    file = tiny.write(aligned, yaml.safe_dump(ALIGNMENT))
    plan = {**PICTURES, "frames": 4, "dark_frames": 2}
    sets = [f"plan={json.dumps(plan)}", f"alignment={aligned / 'alignment.json'}"]
    sets += [f"photographs={aligned / 'photographs'}", "licence=own", "camera.exposure=40 ms"]
    sets += ["virtual.monitor={}", "virtual.display=[90, 100]"]
    store, out = aligned / "p.zarr", aligned / "out"
    asked = [part for one in sets for part in ("--set", one)]
    for args in (("capture", file, "--out", store, *asked), ("run", store, "--out", out)):
        called(*args)
    assert "2 pairs; next: thincam evaluate" in (out / "report.html").read_text("utf-8")
    pairs = open_pairs(out / "pairs")
    assert list(pairs.names) == ["chelsea", "coins"] and pairs.licence == "own (README.md)"
    (top, bottom), (left, right) = pairs.alignment.rows, pairs.alignment.columns
    psf = pairs[0].psf.pixels
    for pair in pairs:
        assert pair.truth.shape == (1, bottom - top, right - left)
        seen = np.zeros(psf.shape)
        seen[top:bottom, left:right] = pair.truth[0]
        model = scipy.signal.fftconvolve(seen[::-1, ::-1], psf)  # its middle is pixel n // 2
        rows, columns = (n // 2 for n in psf.shape)
        model = model[rows : rows + psf.shape[0], columns : columns + psf.shape[1]]
        design = np.stack([model.ravel(), np.ones(model.size)], axis=1)
        capture = pair.capture.pixels.ravel()
        left_over = capture - design @ np.linalg.lstsq(design, capture)[0]
        assert np.std(left_over) < 0.05 * np.std(capture)


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        (["plan.spread=60 mm"], "plan.spread: a mark of 3 mm at -30, -30 mm is not all on the"),
        (["plan.size=null"], "plan.size: a plan of kind alignment needs it"),
        (["optics=null"], "optics: a plan of kind alignment needs optics"),
        (["alignment=a.json"], "alignment: a plan of kind alignment takes none; drop it"),
        ([f"plan={json.dumps(PICTURES)}"], "alignment: a plan of kind pictures with optics"),
        (["photographs=nowhere"], "photographs: 'nowhere' is no folder; give a folder of"),
        (["held_out=1"], "held_out: this file makes 0 pairs; give fewer, or drop it"),
        (["plan.betas=[60 rad/mm^2, 50 rad/mm^2]"], "plan.betas: a plan of kind alignment has one"),
    ],
)
def test_files_that_do_not_fit(file, asked, line):
    assert line in one_line(call("capture", file, *(part for a in asked for part in ("--set", a))))


def test_an_alignment_that_cannot_be_read(file):
    line = one_line(call("capture", file, *pictures("none.json")))
    assert "none.json" in line
