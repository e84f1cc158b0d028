"""The command `thincam train`: a training in its folder, gone on with, and what it refuses."""

import json

import pytest
from commands.pages import assert_says_its_result
from learn import tiny_network as tiny
from typer.testing import CliRunner

from helpers import ROOT
from thincam_jax.commands import cli
from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.learn.commands.refocusing import LearnedConfig, build_camera
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.store import described
from thincam_jax.learn.refocusing.train import NETWORK

FILE = """
name: tiny
kind: learned
wavelength: 500 nm
model: geometric
sensor: {shape: [16, 18], pitch: 44 um}
mask: {beta: 13 rad/mm^2, width: 0.7 mm}
distance: 7.5 mm
focus: {nearest: 50 mm, farthest: 200 mm, shape: [14, 12], planes: 2}
sources:
  - {name: leaves, kind: drawn, count: 4}
scenes: {side: 24}
network: {steps: 1, widths: [4, 4]}
training: {steps: 4, batch: 2, judged: 1, warm_up: 1, check_every: 2}
"""


def call(*arguments):
    return CliRunner().invoke(cli.app, ["train", *(str(a) for a in arguments)])


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(FILE, "utf-8")
    return path


def line(result):
    assert result.exit_code == 2, result.output
    (only,) = result.stderr.splitlines()
    return only.removeprefix("thincam: ")


def test_what_is_there_is_not_lost_and_what_is_not_cannot_be_gone_on_with(file, tmp_path):
    assert "holds no training yet" in line(call(file, "--out", tmp_path, "--resume"))
    (tmp_path / "training-1.state").touch()
    assert "give --resume to go on with it" in line(call(file, "--out", tmp_path))


@pytest.mark.thorough
def test_a_training_is_told_and_gone_on_with(file, tmp_path):
    out = tmp_path / "out"
    done = call(file, "--out", out)
    assert done.exit_code == 0, done.output
    assert "finished: focused images" in done.stdout and str(out / NETWORK) in done.stdout
    result = json.loads((out / "training.json").read_text("utf-8"))
    assert result["steps"] == 4 and len(result["losses"]) == 4 and result["skipped"] == 0
    assert result["trained"]["focus_psnr_db"] > 0 and result["linear"]["consistency"] > 0
    page = assert_says_its_result(out)
    assert "drawn" in page and page.count("data:image/") == 4
    assert RefocusNetwork.load(out / NETWORK, tiny.camera()).camera.planes == 2
    # The folder of a training is not begun anew by accident; what is finished stays as it is.
    assert "give --resume to go on with it" in line(call(file, "--out", out))
    before = (out / NETWORK).read_bytes()
    again = call(file, "--out", out, "--resume")
    assert again.exit_code == 0 and (out / NETWORK).read_bytes() == before
    other = line(call(file, "--out", out, "--resume", "--set", "training.rate=0.5"))
    assert "holds a training of another configuration" in other
    state = out / "training-1.state"
    state.write_bytes(state.read_bytes()[:-1])
    assert "is damaged or cut off" in line(call(file, "--out", out, "--resume"))


@pytest.mark.thorough
def test_the_file_makes_the_camera(file):
    config = load_as(LearnedConfig, file)
    assert described(build_camera(config)) == described(tiny.network().camera)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ("focus.nearest=300mm", "nearest is not below farthest"),
        ("sources.0.use=judge", "none of them is of use 'train'"),
        ("sources.0.path=there", "kind drawn takes no 'path'"),
        ("sources.0.kind=folder", "kind folder needs 'path'"),
        ("sources.0.kind=pairs", r"sources\[0\].kind: pictures on a monitor have no depth"),
        ("sources=pairs", "sources: pictures on a monitor have no depth"),
    ],
)
def test_a_fault_of_the_file_is_told(changed, told, file):
    with pytest.raises(ConfigError, match=told):
        load_as(LearnedConfig, file, (changed,))


def test_the_shipped_file_is_whole():
    config = load_as(LearnedConfig, ROOT / "configs" / "learned_refocus.yaml")
    assert build_camera(config).planes == 7
