"""`thincam train` of a denoiser: its folder, how it is gone on with, and what it refuses."""

import json

import pytest
from typer.testing import CliRunner

from thincam_jax.commands import cli
from thincam_jax.learn.denoiser.network import network_card
from thincam_jax.learn.denoiser.train import NETWORK, STATE

FILE = """
name: tiny
kind: denoiser
sources:
  - {name: drawn, kind: drawn, count: 2}
network: {widths: [4], blocks: [1]}
training: {steps: 4, batch: 2, crop: 8, judged: 1, check_every: 2, warm_up: 1}
"""


def call(*arguments):
    return CliRunner().invoke(cli.app, ["train", *(str(a) for a in arguments)])


def line(result):
    assert result.exit_code == 2, result.output
    (only,) = result.stderr.splitlines()
    return only.removeprefix("thincam: ")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(FILE, "utf-8")
    return path


@pytest.mark.thorough
def test_a_training_is_told_and_gone_on_with(file, tmp_path):
    out = tmp_path / "out"
    done = call(file, "--out", out)
    assert done.exit_code == 0, done.output
    assert "finished: loss" in done.stdout and str(out / NETWORK) in done.stdout
    result = json.loads((out / "training.json").read_text("utf-8"))
    assert result["steps"] == 4 and len(result["scores"]) == 2
    card = network_card(out / NETWORK)
    assert card.images["trained on"][0].licence == "drawn" and card.cpu_seconds > 0
    assert "give --resume to go on with it" in line(call(file, "--out", out))
    assert call(file, "--out", out, "--resume").exit_code == 0
    state = out / STATE
    state.write_bytes(state.read_bytes()[:-1])
    assert "is damaged or cut off" in line(call(file, "--out", out, "--resume"))
    # Its weights are enough for another training, of the same size.
    start = "--set", f"start={out / NETWORK}"
    other = line(call(file, "--out", tmp_path / "b", *start, "--set", "network.widths=[6]"))
    assert "has widths [4] and blocks [1]; give these in the section network" in other
    on = call(file, "--out", tmp_path / "c", *start)
    assert (
        on.exit_code == 0
        and json.loads((tmp_path / "c/training.json").read_text("utf-8"))["steps"] == 4
    )
    images = network_card(tmp_path / "c" / NETWORK).images
    assert images["trained on, before"] == card.images["trained on"] == images["trained on"]
    # A network of the same name with other content.
    kept = (out / NETWORK).read_bytes()
    (out / NETWORK).write_bytes((tmp_path / "c" / NETWORK).read_bytes())
    told = line(call(file, "--out", tmp_path / "c", *start, "--resume"))
    assert f"began with another {out / NETWORK}; restore that, or begin in another folder" in told
    (out / NETWORK).write_bytes(kept)
    assert call(file, "--out", tmp_path / "c", *start, "--resume").exit_code == 0
    assert call(file, "--out", tmp_path / "d", *start).exit_code == 0


def test_what_is_there_is_not_lost_and_what_is_not_cannot_be_gone_on_with(file, tmp_path):
    assert "holds no training yet" in line(call(file, "--out", tmp_path, "--resume"))
    (tmp_path / STATE).touch()
    assert "give --resume to go on with it" in line(call(file, "--out", tmp_path))


def test_what_cannot_be_used_is_told(file, tmp_path):
    def told(setting):
        return line(call(file, "--out", tmp_path / "out", "--set", setting))

    missing = tmp_path / "no.thincam"
    assert f"start: {missing}: is missing; give a network's file" in told(f"start={missing}")
    assert "give as many as widths, one for each of up to 16" in told("network.blocks=[1, 2]")
    assert "held_out names 'dog'; there are drawn" in told("sources.0.held_out=[dog]")
    assert "none of them is of use 'train'" in told("sources.0.use=judge")
    assert "kind drawn takes no 'path'" in told("sources.0.path=there")
    assert "kind folder needs 'path'" in told("sources.0.kind=folder")
    assert "none is left to train on" in told("sources.0.held_out=[drawn]")
    assert not (tmp_path / "out").exists()
