"""Commands as processes on a machine that fails: one line, the right exit code, nothing lost."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen

import pytest
from commands.design import tiny as design
from commands.reconstruct import simulated
from commands.sweep import mini
from hardware.commands import tiny as capture
from learn.commands.test_train_denoiser import FILE as TRAINING

from helpers import ROOT
from thincam_jax.commands.terminal import INTERRUPTED
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.measured.read import read_image

pytestmark = pytest.mark.thorough
FULL_DISK = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))"
# Root may write no more than another user: prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE).
NO_PRINT = "import os; os.dup2(os.open('/dev/full', os.O_WRONLY), 1)"
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
NO_GPU = {"JAX_PLATFORMS": "cuda", "CUDA_VISIBLE_DEVICES": ""}
NO_ROOT = "import ctypes, os; assert os.geteuid() or ctypes.CDLL(None).prctl(24, 1) == 0"


def _reconstruct(folder: Path) -> list[object]:
    files = simulated.grey_files(folder)
    return ["--psf", files["psf"], "--capture", files["capture"], "--background", files["dark"]]


def _train(folder: Path) -> list[object]:
    (folder / "tiny.yaml").write_text(TRAINING, "utf-8")
    return [folder / "tiny.yaml"]


@dataclass(frozen=True)
class Command:
    """A command with its files, and what its result is compared by."""

    name: str
    arguments: Callable[[Path], list[object]]
    result: Callable[[Path], object]
    out: str = "out"
    resume: tuple[str, ...] = ()
    # A file that says that work has begun.
    begun: str = "out/*"


COMMANDS = [
    Command("init", lambda folder: ["study"], lambda out: out.read_text("utf-8"), begun=""),
    Command(
        "run",
        lambda folder: [mini.write(folder)],
        lambda out: json.loads((out / "metrics.json").read_text("utf-8")),
    ),
    Command(
        "sweep",
        lambda folder: [mini.write(folder), "--grid", "seed=1:3:3", "--workers", "1"],
        lambda out: (out / "results.csv").read_text("utf-8").count("\n"),
        begun="out/points/*",
    ),
    Command(
        "design",
        lambda folder: [design.write(folder)],
        lambda out: (out / "found.yaml").read_text("utf-8"),
    ),
    Command(
        "train",
        _train,
        lambda out: json.loads((out / "training.json").read_text("utf-8"))["scores"],
        resume=("--resume",),
        begun="out/training.state",
    ),
    Command(
        "capture",
        lambda folder: [capture.write(folder)],
        lambda out: [Acquisition.load(out).frame(number).shape for number in range(6)],
        out="out.zarr",
        resume=("--resume",),
        begun="out.zarr/journal.jsonl",
    ),
    Command(
        "reconstruct",
        _reconstruct,
        lambda out: read_image(out).pixels.tolist(),
        out="out.png",
        begun="",
    ),
]


def start(command: Command, arguments: list[object], prepare: str = "") -> Popen:
    return process([command.name, *arguments], prepare)


def process(words: list[object], prepare: str = "", **settings: str) -> Popen:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    path = os.pathsep.join(filter(None, [str(ROOT), kept.get("PYTHONPATH")]))
    line = [sys.executable, "-m", "thincam_jax.commands.start", *map(str, words)]
    if prepare:  # in the child: a fork of this process could hang in JAX's threads
        line = [sys.executable, "-c", f"{prepare}\nimport os; os.execv({line[0]!r}, {line})"]
    return Popen(
        line,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**kept, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu", **settings},
    )


def ended(child: Popen) -> None:
    """Wait for a command that must succeed."""
    _, told = child.communicate(timeout=600)
    assert child.returncode == 0, told


def refusal(child: Popen) -> str:
    """The one line of a command that must not succeed, without the line of its progress."""
    _, told = child.communicate(timeout=600)
    lines = [line for line in told.splitlines() if line.startswith("thincam: ")]
    assert child.returncode in (1, 2) and len(lines) == 1 and "Traceback" not in told, told
    return lines[0]


@pytest.fixture(scope="module", params=COMMANDS, ids=lambda one: one.name)
def command(request):
    return request.param


@pytest.fixture(scope="module")
def whole(command, tmp_path_factory):
    """Arguments of a command, and its result where nothing disturbed it."""
    folder = tmp_path_factory.mktemp(command.name)
    arguments = command.arguments(folder)
    ended(start(command, [*arguments, "--out", folder / command.out]))
    return arguments, command.result(folder / command.out)


def test_a_full_disk_is_told_in_one_line(command, whole, tmp_path):
    line = refusal(start(command, [*whole[0], "--out", tmp_path / command.out], FULL_DISK))
    assert str(tmp_path / command.out) in line and "File too large" in line and "make room" in line


def test_a_read_only_folder_is_told_in_one_line(command, whole, tmp_path):
    tmp_path.chmod(0o555)
    child = start(command, [*whole[0], "--out", tmp_path / command.out], NO_ROOT)
    line = refusal(child)
    tmp_path.chmod(0o755)
    assert str(tmp_path) in line and "Permission denied" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=lambda one: one.name)
def test_a_killed_command_goes_on_to_the_same_result(command, whole, tmp_path, number):
    arguments = [*whole[0], "--out", tmp_path / command.out]
    if command.begun:
        child = start(command, arguments)
        while child.poll() is None and not list(tmp_path.glob(command.begun)):
            time.sleep(0.01)
        child.send_signal(number)
        _, told = child.communicate(timeout=600)
        # A capture ends in order, as after Ctrl-C.
        codes = -number, 128 + number, INTERRUPTED
        assert child.returncode in codes and "Traceback" not in told, told
    ended(start(command, [*arguments, *command.resume]))
    assert command.result(tmp_path / command.out) == whole[1]


def test_two_at_once_on_one_cache(tmp_path):
    """Each finds the programs whole that the other has written."""
    command = next(one for one in COMMANDS if one.name == "run")
    arguments, cache = command.arguments(tmp_path), {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    outs = [tmp_path / "first", tmp_path / "second", tmp_path / "third"]
    children = [process(["run", *arguments, "--out", out], **cache) for out in outs[:2]]
    for child in children:
        ended(child)
    ended(process(["run", *arguments, "--out", outs[2]], **cache))
    first, *others = (command.result(out) for out in outs)
    assert others == [first, first]


GUARDED = {"JAX_TRANSFER_GUARD": "disallow", "JAX_NUMPY_RANK_PROMOTION": "raise"}


@pytest.mark.parametrize(
    ("words", "prepare", "settings", "code", "text"),
    [
        (["explain", ROOT / "configs/fza_superresolution.yaml"], "", ASCII, 0, "\\u03b2"),
        (["schema", "study"], "", ASCII, 0, "fill_factor \\u2264 1"),
        (["doctor", "--all"], "", {"MPLBACKEND": "banana"}, 0, "devices: cpu:0"),
        (["doctor"], "", NO_GPU, 2, "JAX cannot start with JAX_PLATFORMS=cuda"),
        (
            ["doctor"],
            "",
            GUARDED,
            2,
            "JAX_TRANSFER_GUARD=disallow forbids to read a file into an array",
        ),
        (["doctor"], NO_PRINT, {}, 2, "No space left on device"),
        (["--version"], NO_PRINT, {}, 2, "No space left on device"),
        (["schema", "study"], NO_PRINT, {}, 2, "No space left on device"),
    ],
    ids=lambda one: " ".join(map(str, one)) if isinstance(one, list | dict) else "",
)
def test_a_faulty_environment_costs_a_line_or_nothing(words, prepare, settings, code, text):
    child = process(words, prepare, PYTHONUNBUFFERED="", **settings)
    printed, told = child.communicate(timeout=600)
    assert child.returncode == code and "Traceback" not in told, told
    assert told.count("\n") == (code > 0) and text in (told if code else printed)


OPENED = """
import sys
from thincam_jax.commands import start
sys.argv = ["thincam", "--version"]
try:
    start.main()
except SystemExit:
    pass
with open("opened", "w") as file:
    file.write(str(file.fileno()))
"""


def test_no_file_has_the_number_of_a_closed_stream(tmp_path):
    """Ctrl-C and the libraries in C write to 2, whatever it is: to no journal and no image."""
    settings = {**os.environ, "PYTHONPATH": str(ROOT)}
    line = ["sh", "-c", '"$0" -c "$1" <&- >&- 2>&-', sys.executable, OPENED]
    assert subprocess.run(line, cwd=tmp_path, env=settings).returncode == 0
    assert int((tmp_path / "opened").read_text("utf-8")) > 2


def test_with_closed_streams_the_result_is_the_same(tmp_path):
    command = next(one for one in COMMANDS if one.name == "run")
    arguments, closed = command.arguments(tmp_path), "import os; os.closerange(0, 3)"
    for out, prepare in ((tmp_path / "first", ""), (tmp_path / "second", closed)):
        ended(start(command, [*arguments, "--out", out], prepare))
    assert command.result(tmp_path / "second") == command.result(tmp_path / "first")
