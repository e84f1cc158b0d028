"""Rooms that may be left out: without each of them the rest of the package works.

That nothing else waits for them is a rule of `tests/test_architecture.py`; here they are gone.
"""

import os
import shutil
import subprocess
import sys

import pytest
import yaml
from source_tree import PACKAGE
from test_architecture import CLOSED

from helpers import ROOT
from thincam_jax.commands.kinds import KINDS, ROOMS

# Tests of what any camera needs, and of each closed room that is left.
CORE = ("lensless/test_psf.py", "reconstruction/test_admm.py", "commands/study/test_run.py")
TESTS = {
    "hardware": ("hardware/commands/test_scene.py", "hardware/test_preview.py"),
    "waveguide": ("waveguide/studies/test_screen.py", "waveguide/test_rays.py"),
    "learn": ("learn/test_residual_noise.py", "learn/commands/test_train_denoiser.py"),
}
PNP = ("methods.0.kind=pnp", "methods.0.synthesis=separate")
# Commands of others that need a room, and what they say.
NEEDING = {
    "hardware": (("run", "out"), "this needs thincam_jax.hardware"),
    "waveguide": (
        ("explain", "configs/rig_hadamard.yaml"),
        "configs/rig_hadamard.yaml:38: virtual.screen: needs thincam_jax.waveguide",
    ),
    "learn": (
        ("run", "configs/quick.yaml", "--dry-run", "--set", PNP[0], "--set", PNP[1]),
        "this needs thincam_jax.learn",
    ),
}
IMPORTS = """
import importlib, pkgutil, sys
import thincam_jax as tc
for module in pkgutil.walk_packages(tc.__path__, "thincam_jax."):
    importlib.import_module(module.name)
print(tc.__file__, len(sys.modules))
"""
COMMAND = "from thincam_jax.commands.start import main; main()"


def test_the_registry_knows_the_closed_rooms():
    assert tuple(sorted(ROOMS)) == tuple(sorted(CLOSED))
    assert {kind.room for kind in KINDS.values()} == {*ROOMS, ""}


@pytest.mark.thorough
@pytest.mark.parametrize("room", CLOSED)
def test_the_rest_works_without(room, tmp_path):
    ignore = shutil.ignore_patterns("__pycache__", ".*")
    for folder in (PACKAGE, "tests", "configs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for folder in (PACKAGE, "tests"):
        shutil.rmtree(tmp_path / folder / room)
    own = {name: kind for name, kind in KINDS.items() if kind.room == room}
    for path in tmp_path.glob("configs/*.yaml"):
        if yaml.safe_load(path.read_text("utf-8")).get("kind") in own:
            path.unlink()

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        own = {**os.environ, "PYTHONPATH": str(tmp_path), "MPLBACKEND": "Agg"}
        call = [sys.executable, "-W", "ignore", *words]
        return subprocess.run(call, capture_output=True, text=True, cwd=tmp_path, env=own)

    done = run("-c", IMPORTS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path))
    for words in (("run", "configs/quick.yaml", "--out", "out"), ("doctor",), ("init",)):
        done = run("-c", COMMAND, *words)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/report.html").is_file()
    for name, kind in own.items():
        file = tmp_path / f"{name}.yaml"
        shutil.copy(ROOT / f"configs/{kind.example}.yaml", file)
        told = f"thincam: {file}: kind: {name} needs thincam_jax.{room}, which this installation"
        done = run("-c", COMMAND, "explain", str(file))
        assert (done.returncode, done.stderr) == (2, f"{told} has not\n")
    words, told = NEEDING[room]
    done = run("-c", COMMAND, *words)
    assert (done.returncode, done.stderr) == (
        2,
        f"thincam: {told}, which this installation has not\n",
    )
    left = [test for other in CLOSED if other != room for test in TESTS[other]]
    tests = [f"tests/{test}" for test in (*CORE, *left)]
    done = run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests)
    assert done.returncode == 0, done.stdout
