"""Captures of a virtual rig, a reconstruction trained on them, and its images of others."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import PIL.Image
import pytest
import yaml
from commands.test_cli import call, called
from hardware.commands import tiny
from hardware.commands.test_alignment import ALIGNMENT, PICTURES

from helpers import ROOT
from thincam_jax.learn.commands.trained import TrainedConfig, build_lessons
from thincam_jax.learn.trained import training_record
from thincam_jax.learn.trained_lessons import PairLessons
from thincam_jax.learn.trained_training import NETWORK, STATE
from thincam_jax.measured.calibration.alignment import Alignment

PHOTOGRAPHS, HELD_OUT = 10, 3
TRAINING = {
    "name": "tuned",
    "kind": "trained",
    "sources": [{"name": "drawn", "kind": "drawn", "count": 4}],
    "network": {"iterations": 20, "widths": [12, 16]},
    "training": {
        **{"steps": 200, "pool": 4, "fitted": 1, "judged": 4, "batch": 4, "crop": 16},
        **{"check_every": 50, "warm_up": 5, "rate": 0.003, "averaging": 0.9},
    },
}


def steps(image):
    """Bars and a disc: what total variation blurs behind a small zone plate."""
    y, x = np.mgrid[:32, :32]
    rng = np.random.default_rng(image)
    period, angle = rng.uniform(5, 12), rng.uniform(0, np.pi)
    bars = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period) > 0
    disc = np.hypot(*(rng.uniform(8, 24, (2, 1, 1)) - (y, x))) < rng.uniform(4, 9)
    return np.uint8(np.where(disc, 255 * rng.uniform(0, 1), 60 + 150 * bars))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The rig's store of photographs before an aligned monitor."""
    folder = tmp_path_factory.mktemp("rig")
    known = np.array([1.0, 0.0, 0.0, 0.0]), 1e-8 * np.eye(4)
    Alignment((90, 100), 0.5, *known, 9, 9, 0.01).save(folder / "alignment.json")
    (folder / "photographs").mkdir()
    for number in range(PHOTOGRAPHS):
        image = PIL.Image.fromarray(steps(number))
        image.save(folder / "photographs" / f"{number}.png")
    rig = yaml.safe_load(yaml.safe_dump(ALIGNMENT)) | {
        "name": "rig",
        "plan": {**PICTURES, "frames": 4, "dark_frames": 2},
        "alignment": str(folder / "alignment.json"),
        "photographs": str(folder / "photographs"),
        "licence": "own",
        "held_out": HELD_OUT,
    }
    rig["camera"]["exposure"] = "40 ms"
    rig["virtual"] |= {"monitor": {}, "display": [90, 100]}
    file = tiny.write(folder, yaml.safe_dump(rig))
    called("capture", file, "--out", folder / "rig.zarr")
    return folder


def train(file, out, *more):
    return call("train", file, "--out", out, *more)


@pytest.mark.thorough
def test_from_captures_to_a_network_that_is_scored_on_others(home):
    """By its commands alone; a training that was killed ends with the same network."""
    done = called("run", home / "rig.zarr", "--out", home / "rig")
    data, out = home / "rig/pairs", home / "whole"
    file = home / "tuned.yaml"
    named = {"psf": {"path": str(data / "psf.tif")}, "pairs": {"path": str(data), "judged": 2}}
    file.write_text(yaml.safe_dump(TRAINING | named), "utf-8")

    # The train split alone is read.
    config = TrainedConfig.model_validate(TRAINING | named)
    learned_from = build_lessons(config).train
    assert isinstance(learned_from, PairLessons)
    known = [str(n) for n in range(PHOTOGRAPHS - HELD_OUT)]
    assert [*learned_from.pairs.names] == known and learned_from.most == len(known) - 2

    assert train(file, out).exit_code == 0
    killed = home / "killed"
    command = "from thincam_jax.commands.start import main; main()"
    arguments = [sys.executable, "-c", command, "train", str(file), "--out", str(killed)]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_ENABLE_X64": "1"}
    process = subprocess.Popen(arguments, env=env)
    while process.poll() is None and not (killed / STATE).exists():
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (killed / STATE).exists() and not (killed / "training.json").exists()
    done = train(file, killed, "--resume")
    assert done.exit_code == 0, done.output
    assert (killed / NETWORK).read_bytes() == (out / NETWORK).read_bytes()
    images = training_record(out / NETWORK)["images"]
    assert [one["name"] for one in images["trained on"]] == known[:-2]
    assert [one["name"] for one in images["judged on"]] == known[-2:]
    assert {one["licence"] for one in images["trained on"]} == {"own (README.md)"}

    # From the camera alone, then on its pairs.
    del named["pairs"]
    alone = home / "camera.yaml"
    alone.write_text(yaml.safe_dump(TRAINING | named | {"name": "camera"}), "utf-8")
    assert train(alone, home / "camera").exit_code == 0
    start = "--set", f"start={home / 'camera' / NETWORK}"
    assert train(file, home / "both", *start).exit_code == 0

    methods = ["admm-tv"]
    for name in ("whole", "camera", "both"):
        (home / name / NETWORK).rename(home / f"{name}.thincam")
        methods.append(str(home / f"{name}.thincam"))
    asked = [word for one in methods for word in ("--method", one)]
    called("evaluate", data, *asked, "--workers", 1, "--out", home / "scores")
    with open(home / "scores/table.csv", encoding="utf-8") as table:
        rows = list(csv.DictReader(table))
    assert {row["name"] for row in rows} == {"7", "8", "9"}
    gains = {one["method"]: one["beside"] for one in metrics(home / "scores")}
    assert [*gains] == ["admm_tv", "whole", "camera", "both"]
    assert all(gains[name]["half"] > 0 for name in ("whole", "camera", "both"))
    # All that the camera's network adds loses 0.42 dB on another rig's scenes; judges keep half.
    assert training_record(home / "camera.thincam")["part"] < 1
    assert gains["camera"]["mean"] > -0.21
    # What pairs teach holds for captures held out, if a few of them teach little.
    assert gains["whole"]["mean"] > gains["camera"]["mean"] + 0.08


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text("utf-8"))["scores"]
