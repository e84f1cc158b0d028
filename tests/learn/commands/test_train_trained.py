"""`thincam train` of a reconstruction, and its file as a method of the commands."""

import contextlib
import json

import numpy as np
import pytest
from learn.commands.test_train_denoiser import call, line
from learn.test_trained import drawn_psf
from typer.testing import CliRunner

from thincam_jax.commands import cli
from thincam_jax.commands.evaluate import run as evaluation
from thincam_jax.learn.trained import TrainedReconstruction

FILE = """
name: tiny
kind: trained
psf: {path: psf.npy, background: 0.0}
sources:
  - {name: drawn, kind: drawn, count: 2}
network: {iterations: 5, widths: [4]}
training: {steps: 4, pool: 2, fitted: 1, batch: 2, crop: 16, judged: 1, check_every: 2, warm_up: 1}
"""
PSF = drawn_psf(0, (24, 32))


@pytest.fixture
def file(tmp_path):
    np.save(tmp_path / "psf.npy", PSF[0])
    path = tmp_path / "tiny.yaml"
    path.write_text(FILE, "utf-8")
    return path


def trained_file(folder, psf=PSF):
    """An untrained reconstruction's file, that of a network of the camera."""
    from thincam_jax.learn.trained import TrainedOptions

    made = TrainedReconstruction.create(TrainedOptions(iterations=5, widths=(4,)), psf, key=0)
    return made.save(folder / "mine.thincam")


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])


def test_what_cannot_be_used_is_told(file, tmp_path):
    def told(*settings):
        options = [word for one in settings for word in ("--set", one)]
        return line(call(file, "--out", tmp_path / "out", *options))

    assert "psf: " in told("psf.path=no.npy") and "no.npy" in told("psf.path=no.npy")
    assert "training.crop = 30: give at most 24" in told("training.crop=30")
    other = trained_file(tmp_path, drawn_psf(8, (24, 32)))
    same = "network={iterations: 5, widths: [4]}"
    assert "it is another camera" in told(f"start={other}", same)
    assert "give the fewest first" in told("faults.electrons=[9, 3]")


def in_turn(function, arguments):
    """Tasks, done in this process."""
    for name, given in arguments.items():
        yield name, function(*given)


def test_its_file_is_a_method_of_the_commands(tmp_path, monkeypatch):
    np.save(tmp_path / "psf.npy", PSF[0])
    path, data = trained_file(tmp_path), tmp_path / "data"
    for folder in ("captures", "truths"):
        (data / folder).mkdir(parents=True)
        light = 100 + 900 * np.random.default_rng(0).random((24, 32)).astype(np.float32)
        np.save(data / folder / "a.npy", light)
    files = "--psf", tmp_path / "psf.npy", "--background", "0"
    capture = "--capture", data / "captures/a.npy", "--out", tmp_path / "image.npy"
    done = run("reconstruct", *files, *capture, "--method", path)
    assert done.exit_code == 0, done.output
    assert np.load(tmp_path / "image.npy").shape[-2:] == (24, 32)
    record = json.loads((tmp_path / "image.json").read_text("utf-8"))
    assert record["reconstruction"]["method"] == "trained"
    assert record["reconstruction"]["tau"] is None
    told = line(run("reconstruct", *files, *capture, "--method", path, "--tau", "2"))
    assert told == "a trained reconstruction has no tau; leave it out"
    told = line(run("reconstruct", *files, *capture, "--method", tmp_path / "no.thincam"))
    assert "no.thincam: is missing; give a file that 'thincam train' wrote" in told
    monkeypatch.setattr(evaluation, "workers_of", lambda *_: contextlib.nullcontext(in_turn))
    compared = run("evaluate", data, *files, "--method", path, "--method", "ridge", "--out",
                   tmp_path / "scores", "--workers", "1")  # fmt: skip
    assert compared.exit_code == 0, compared.output
    table = (tmp_path / "scores/table.csv").read_text("utf-8")
    assert "0,a,mine," in table and "0,a,ridge," in table
    path.write_bytes(path.read_bytes()[:-1])
    told = line(run("evaluate", data, *files, "--method", path))
    assert "is damaged or cut off" in told
