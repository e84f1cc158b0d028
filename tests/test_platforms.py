"""The core on systems without POSIX's modules, such as Windows, in a process that hides them.

The workflows that try it on such systems.
"""

import subprocess
import sys

import check_jsonschema
import pytest
from click.testing import CliRunner

from helpers import ROOT

HIDDEN = ("fcntl", "resource", "termios", "grp", "pwd", "tty", "pty")
MISSING = ("sched_getaffinity", "getuid", "geteuid", "fork", "sysconf", "O_NOFOLLOW", "O_DIRECTORY")
PROGRAM = f"""
import os, signal, sys
import jax, equinox, matplotlib.pyplot, numpy, optimistix, PIL.Image, platformdirs.unix
import rich.console, scipy.signal
import skimage.transform, tifffile, typer, yaml

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in {HIDDEN}:
            raise ModuleNotFoundError("No module named " + name, name=name)

for name in {HIDDEN}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
for name in {MISSING}:
    if hasattr(os, name):
        delattr(os, name)
for name in ("pthread_kill", "SIGHUP", "pthread_sigmask"):
    delattr(signal, name)
"""
IMPORTS = """
import importlib, pkgutil, thincam_jax
def failed(name):
    if not name.startswith("thincam_jax.hardware"):
        raise
found = []
for module in pkgutil.walk_packages(thincam_jax.__path__, "thincam_jax.", failed):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        found.append((module.name, error.name))
print([pair for pair in found if not pair[0].startswith("thincam_jax.hardware")])
print(len(found) < 12)
"""
WORK = """
import numpy as np
import thincam_jax as tc
from thincam_jax._core.environment import usable_cores
from thincam_jax._core.memory import available_bytes
assert usable_cores() > 0
available_bytes()
mask = tc.FresnelZoneAperture(25.0, width=1.6)
camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 0.05), distance=5.0)
scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 5e-4)
optics = tc.Cameras([camera], wavelength=5e-4, object_distance=250.0)
recording = tc.Recording([tc.capture(camera, scene)], optics)
result = tc.reconstruct(recording, tc.AdmmTV(iterations=10))
print(bool(np.isfinite(result.image).all()))
from typer.testing import CliRunner
from thincam_jax.commands import cli
for words in (["--help"], ["init", "--help"], ["explain", sys.argv[1]]):
    found = CliRunner().invoke(cli.app, words)
    print(found.exit_code, found.exception)
"""


@pytest.mark.thorough
def test_the_core_needs_no_posix(tmp_path):
    """All but the rig is imported; a camera is simulated, reconstructed and explained."""
    study = tmp_path / "study.yaml"
    study.write_bytes((ROOT / "configs/quick.yaml").read_bytes())
    program = PROGRAM + IMPORTS + WORK
    words = [sys.executable, "-W", "ignore", "-c", program, str(study)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["[]", "True", "True"] + ["0 None"] * 3


@pytest.mark.parametrize(
    ("schema", "files"), [("github-workflows", "workflows/*.yml"), ("dependabot", "dependabot.yml")]
)
def test_workflows_are_as_their_schemas_say(schema, files):
    paths = [str(path) for path in sorted((ROOT / ".github").glob(files))]
    options = ["--builtin-schema", f"vendor.{schema}", *paths]
    checked = CliRunner().invoke(check_jsonschema.main, options)
    assert paths and checked.exit_code == 0, checked.output
