"""The ways through the source that CONTRIBUTING.md names: a run enters each of their files."""

import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from commands.study import tiny
from commands.study.tiny import Told

import thincam_jax as tc
from helpers import ROOT
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.run import run_study
from thincam_jax.units import nm, um

PACKAGE = ROOT / "thincam_jax"
_, STUDY, RECONSTRUCTION = (
    (ROOT / "CONTRIBUTING.md").read_text("utf-8").split("\n## From a file")[1].split("\n## ")[0]
).split("\n\nA ")


def files_of(way: str) -> list[tuple[str, str]]:
    """File and name of each step, but of what follows a full stop."""
    return re.findall(r"`([\w/]+\.py)`\s+\(`(\w+)`\)", way)


def entered(run) -> set[tuple[str, str]]:
    """File and name of each function of the package that a call enters."""
    found = set()

    def watch(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(str(PACKAGE)):
            path = Path(frame.f_code.co_filename).relative_to(PACKAGE)
            found.add((path.as_posix(), frame.f_code.co_name))

    before = sys.getprofile()
    jax.clear_caches()  # what is compiled already would not be entered
    sys.setprofile(watch)
    try:
        run()
    finally:
        sys.setprofile(before)
    return found


@pytest.mark.thorough
def test_a_study_is_read_in_six_files(tmp_path):
    way = files_of(STUDY)
    assert len(way) == 6
    found = entered(
        lambda: run_study(build_study(tiny.study(tmp_path)), RunFolder(tmp_path / "out"), Told())
    )
    called = [step for step in way if step[1] != "StudyConfig"]
    assert len(called) == 5 and set(called) <= found


@pytest.mark.thorough
def test_a_reconstruction_is_read_in_eight_files():
    way = files_of(RECONSTRUCTION)
    assert len(way) == 8
    mask = tc.FresnelZoneAperture(beta=25.0, width=0.5)
    cameras = tc.Cameras(
        [tc.LenslessCamera(mask, tc.Sensor((20, 28), 20 * um), distance=3.0)],
        wavelength=500 * nm,
        object_distance=100.0,
    )
    recording = tc.Recording([jnp.ones((20, 28))], cameras)
    found = entered(lambda: tc.reconstruct(recording, tc.AdmmTV(iterations=2)))
    assert set(way) <= found
