"""The command: exit codes, one clear line for what a user can put right, and how to go on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands.study import tiny
from typer.testing import CliRunner

from helpers import ROOT, full_disk
from thincam_jax._core import environment as installation
from thincam_jax._core.program_cache import cache_state
from thincam_jax.commands import cli
from thincam_jax.commands.kinds import examples
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study import run as studies
from thincam_jax.studies.result import StudyScores

runner = CliRunner()


def call(*arguments):
    return runner.invoke(cli.app, [str(a) for a in arguments])


def called(*arguments):
    """The result of a call that succeeds."""
    result = call(*arguments)
    assert result.exit_code == 0, result.output
    return result


def one_line(result):
    """The one line on stderr of a call that ended with exit code 2, without "thincam: "."""
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("thincam: ")
    return line.removeprefix("thincam: ")


@pytest.fixture
def file(tmp_path):
    return tiny.write(tmp_path)


@pytest.mark.thorough
def test_run_prints_the_results_and_where_the_report_is(tmp_path):
    """All options at once; the same command a second time ends with the same figures."""
    methods, targets = (
        tiny.TEXT.split("  - name: pairs\n")[0],
        "targets: [{name: chart, kind: usaf1951}]",
    )
    file = tiny.write(tmp_path, f"{methods}{targets}\n")
    command = ("run", file, "--out", tmp_path / "out", "--set", "seed=9", "--set", "title=T")
    first = called(*command)
    assert (tmp_path / "out" / "report.html").exists()
    config = (tmp_path / "out" / "config.yaml").read_text("utf-8")
    assert "seed: 9\n" in config
    assert "title: T\n" in config
    assert f"report: {tmp_path / 'out' / 'report.html'}" in first.stdout
    row = next(line for line in first.stdout.splitlines() if "conventional" in line and "│" in line)
    assert "20.3" in row  # published
    assert "5.00" in row  # resolved, mm
    assert first.stderr == ""
    again = called(*command)
    assert row in again.stdout


NOTHING = StudyScores("", 0, {}, [])


def test_default_folder_is_named_after_the_study(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = []
    monkeypatch.setattr(
        studies, "run_study", lambda _, folder, __: folders.append(folder.path) or NOTHING
    )
    assert call("run", file).exit_code == 0
    # A name of dots does not lead out of the folder.
    assert call("run", file, "--set", "name=..").exit_code == 0
    assert [path.as_posix() for path in folders] == ["runs/tiny", "runs/unnamed"]


class TestExitCode2:
    def test_fault_in_the_file(self, file, tmp_path):
        text = file.read_text("utf-8").replace("width: 2 mm", "width: 2")
        file.write_text(text, encoding="utf-8")
        number = next(n for n, row in enumerate(text.split("\n"), 1) if row.startswith("mask:"))
        line = one_line(call("run", file, "--out", tmp_path / "out"))
        assert line.startswith(f"{file}:{number}: mask.width: 2 has no unit")
        assert not (tmp_path / "out").exists()

    def test_another_configuration_has_a_folder_of_its_own(self, file, tmp_path, monkeypatch):
        """Without --out the next free number is taken, and the same configuration's found again."""
        monkeypatch.chdir(tmp_path)
        for taken in ("x", "x-2"):
            Path("runs", taken).mkdir(parents=True)
            Path("runs", taken, "config.yaml").write_text("name: other\n", encoding="utf-8")
        given = ("--set", "name=x", "--set", "seed=4", "--dry-run")
        said = "runs/x holds another configuration: writes to runs/x-3"
        assert said in call("run", file, *given).output

    @pytest.mark.parametrize("shape", ["[2000000, 2000000]", "[100, 100000000000]"])
    def test_more_than_the_memory(self, file, shape, tmp_path):
        """Refused before any work, with the estimate."""
        out = ("--out", tmp_path / "out")
        line = one_line(call("run", file, *out, "--set", f"sensor.shape={shape}"))
        assert " needs about " in line
        assert "iB" in line
        assert " are free; " in line
        assert line.startswith(f"--set sensor.shape={shape}: sensor.shape: ")

    def test_unknown_option_and_command(self, file):
        for result in (call("run", file, "--ouput", "x"), call("rum", file), call("run")):
            assert result.exit_code == 2
            assert "Traceback" not in result.output
        assert "No such option" in call("run", file, "--ouput", "x").stderr

    def test_an_option_of_one_value_given_twice(self):
        line = call("examine", "a.tif", "--psf", "a.tif", "--psf", "b.tif").stderr
        assert "--psf is given 2 times; give it once" in line


def test_defect_keeps_its_traceback(file, monkeypatch, tmp_path):
    """Only what a user can put right is made a line of."""

    def broken(*_):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(studies, "run_study", broken)
    result = call("run", file, "--out", tmp_path / "out")
    assert isinstance(result.exception, ZeroDivisionError)


@pytest.mark.parametrize(("done", "hint"), [([], "no target yet"), (["chart"], "chart")])
def test_interrupt(file, monkeypatch, tmp_path, done, hint):
    def interrupted(study, folder, progress):
        folder.claim(study.config)
        for name in done:
            folder.finish(name, {"metrics": {}, "contrasts": {}})
        progress("picture: capture 1", 9)
        raise KeyboardInterrupt

    monkeypatch.setattr(studies, "run_study", interrupted)
    result = call("run", file, "--out", tmp_path / "out")
    assert result.exit_code == 130
    expected = f"thincam: interrupted; finished: {hint}. The same command goes on from there."
    assert result.stderr.splitlines() == [expected]


def test_full_disk(file, monkeypatch, tmp_path):
    """One line, and what was finished is there."""

    def fill(study, folder, progress):
        folder.claim(study.config)
        progress("chart", 9)
        folder.finish("chart", {"metrics": {}, "contrasts": {}})
        folder.write("figures/mtf.png", bytes(4_000))

    monkeypatch.setattr(studies, "run_study", fill)
    out = tmp_path / "out"
    with full_disk(3_000):
        line = one_line(call("run", file, "--out", out))
    assert line.startswith(f"{out}/figures/mtf.png: cannot be written (File too large); make room")
    assert RunFolder(out).finished("chart") is not None
    assert list((out / "figures").iterdir()) == []
    # What cannot even begin says so of its first file.
    with full_disk(3_000):
        line = one_line(call("run", file, "--out", out / "other", "--set", f"title={'T' * 3_000}"))
    assert line.startswith(f"{out}/other/config.yaml: cannot be written")


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 4294967296 bytes.")],
)
def test_memory_that_ends_has_words(file, monkeypatch, tmp_path, error):
    def broken(*_):
        raise error

    monkeypatch.setattr(studies, "run_study", broken)
    line = one_line(call("run", file, "--out", tmp_path / "out"))
    assert line.startswith("out of memory; give fewer pixels")


# A process whose start-up is held where a second module is imported, and one that has begun.
_STARTING = """
import builtins, os, signal, sys
from thincam_jax.commands import start
real, sys.argv = builtins.__import__, ["thincam", "doctor"]
def slow(name, *more):
    if name == {held!r}:
        os.kill(os.getpid(), signal.SIGINT)
    return real(name, *more)
builtins.__import__ = slow
start.main()
"""
_SWALLOWED = """
import gc, os, signal, sys, time
from thincam_jax.commands import terminal as interrupt
signal.signal(signal.SIGINT, interrupt.leave)
sys.unraisablehook = interrupt._again
gc.callbacks.append(lambda phase, _: phase == "stop" and os.kill(os.getpid(), signal.SIGINT))
with interrupt.interruptible():
    try:
        gc.collect()
        gc.callbacks.clear()
        time.sleep(20)  # which the signal ends
    except KeyboardInterrupt:
        print("told", flush=True)
        os._exit(interrupt.INTERRUPTED)
"""


@pytest.mark.parametrize(
    ("code", "streams"),
    [
        (_STARTING.format(held="typer"), ("", "thincam: interrupted\n")),
        (_STARTING.format(held="jax"), ("", "thincam: interrupted\n")),
        (_SWALLOWED, ("told\n", "")),
    ],
    ids=["first import", "JAX", "swallowed by a callback"],
)
def test_ctrl_c_at_any_moment(code, streams):
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        timeout=120,
    )
    assert (done.returncode, (done.stdout, done.stderr)) == (130, streams)


def test_doctor():
    result = called("doctor", "--all")
    found = installation.environment()
    lines = result.stdout.splitlines()
    assert lines[0].startswith("ready: simulate, reconstruct, design, ")
    assert f"Python {found['python']} on {found['platform']}" in lines
    assert "devices: " + ", ".join(found["devices"]) in lines
    assert any(line.startswith(f"cores: {installation.usable_cores()}; memory: ") for line in lines)
    assert "  float64: yes" in lines
    assert "  compiled sums: right" in lines
    assert f"jax {found['versions']['jax']}" in lines
    assert f"compiled programs: {cache_state()}" in lines


def test_doctor_begins_with_a_verdict(monkeypatch):
    """And no more than that, but for what an extra brings."""
    real = installation.installed
    monkeypatch.setattr(installation, "installed", lambda names: real({*names} - {"dask"}))
    first, missing, more = call("doctor").stdout.splitlines()
    assert first.startswith("ready: simulate, reconstruct, design, ") and "sweeps" not in first
    assert missing == "not installed: sweeps (dask); pip install 'thincam-jax[sweep]'"
    assert more.endswith("thincam doctor --all")
    monkeypatch.setattr(installation, "PACKAGES", ("no-such-package",))
    assert call("doctor").stdout.startswith("not ready: no-such-package is not installed\n")


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("thincam re", ["reconstruct"]),
        ("thincam calibrate ", ["check"]),
        ("thincam init des", [kind for kind in examples() if kind.startswith("des")]),
        ("thincam reconstruct --method a", ["auto", "admm-tv"]),
        ("thincam reconstruct --bayer R", ["RGGB"]),
    ],
)
def test_completion(typed, completed):
    words = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    given = {"_THINCAM_COMPLETE": "complete_bash", **words}
    result = runner.invoke(cli.app, [], prog_name="thincam", env=given)
    assert result.stdout.split() == completed


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        ("JAX_PLATFORMS=banana", "Unable to initialize backend 'banana'"),
        ("JAX_ENABLE_X64=banana", "invalid truth value 'banana'"),
    ],
)
def test_settings_with_which_jax_cannot_start(setting, fault, file):
    name, value = setting.split("=")
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "thincam_jax.commands.start", "run", str(file), "--dry-run"]
    environment = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu", name: value}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert f"{setting} ({fault}" in done.stderr.replace("JAX_PLATFORMS=cpu ", "")
    assert done.stderr.endswith("; unset it\n")


@pytest.mark.parametrize("words", [("reconstruct",), ("calibrate", "check")])
def test_a_file_for_a_command_of_options_is_told_where_to_go(file, words):
    line = one_line(call(*words, file))
    assert line == f"{file}: is a study; give it to 'thincam run'"


def test_help_is_in_the_order_of_use():
    listed = call("--help").stdout.partition("Commands:")[2].splitlines()
    assert [line.split()[0] for line in listed if line] == list(cli.ORDER)
    text = call("reconstruct", "--help").stdout
    titles = ("Options:", *(f"{group}:" for group in cli.GROUPS), "Examples:")
    assert [line.strip() for line in text.splitlines() if line.strip() in titles] == list(titles)
    assert text.index("--psf ") < text.index("Calibration:") < text.index("--dead")
    for command in ("init", "run", "reconstruct", "sweep", "design"):
        assert f"Examples:\n    thincam {command} " in call(command, "--help").stdout
