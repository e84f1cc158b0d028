"""Commands under `python -O`, which leaves out assertions, and -OO, docstrings too.

scikit-image 0.26 cannot resize under -OO (its `skimage.transform` edits a docstring).
"""

import subprocess
import sys

import pytest
from commands.reconstruct.simulated import grey_files
from commands.sweep import mini
from learn.commands.test_train_denoiser import FILE

from helpers import ROOT


def run(*words, without="-O"):
    line = [sys.executable, without, "-m", "thincam_jax.commands.start", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["auto", "ridge", "admm-tv", "pnp"])
def test_a_capture_is_reconstructed(tmp_path, method):
    files = grey_files(tmp_path)
    given = ("--psf", files["psf"], "--capture", files["capture"], "--background", files["dark"])
    run("reconstruct", *given, "--method", method, "--out", tmp_path / "out.tif", without="-OO")
    assert (tmp_path / "out.tif").exists()


@pytest.mark.thorough
def test_experiments_are_run(tmp_path):
    study, denoiser = mini.write(tmp_path), tmp_path / "denoiser.yaml"
    denoiser.write_text(FILE, "utf-8")
    run("explain", study)
    run("run", study, "--out", tmp_path / "study")
    run("train", denoiser, "--out", tmp_path / "network")
    run("capture", ROOT / "configs/rig_virtual.yaml", "--dry-run")
    run("design", ROOT / "configs/design_distances.yaml", "--dry-run")
    run("run", ROOT / "configs/sts_camera.yaml", "--dry-run")
