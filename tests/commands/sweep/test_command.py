"""The command `thincam sweep`: what it prints, its exit codes, and its one line for each fault."""

import importlib.util

import pytest
from commands.sweep import mini
from commands.test_cli import call, called, one_line

from helpers import ROOT
from thincam_jax.commands.sweep import command, run
from thincam_jax.commands.sweep.run import Swept


@pytest.fixture
def file(tmp_path):
    return mini.write(tmp_path)


@pytest.fixture
def asked(monkeypatch):
    """In place of a sweep: returns what it was asked for."""
    given = []

    def swept(points, folder, progress, **options):
        given.append((points, folder, options))
        progress(len(points), 0)
        return Swept(len(points), len(points), [])

    monkeypatch.setattr(run, "run_sweep", swept)
    return given


@pytest.mark.parametrize(("rows", "code"), [(3, 0), (0, 2)])
def test_failures_are_told(file, tmp_path, monkeypatch, rows, code):
    failed = [{"values": {"seed": 7}, "reason": "[red]worker died"}] * (4 - rows)
    monkeypatch.setattr(run, "run_sweep", lambda *_, **__: Swept(4, rows, failed))
    out = tmp_path / "out"
    result = call("sweep", file, "--grid", "seed=0:3:4", "--out", out)
    assert result.exit_code == code
    (line,) = result.stderr.splitlines()
    assert line == (
        f"thincam: {4 - rows} of 4 points failed; the first (seed=7): [red]worker died; all are in "
        f"{out / 'failures.jsonl'}. The same command tries them again."
    )
    assert ("3 of 4 points: " in result.stdout) == (rows == 3)


@pytest.mark.parametrize(
    ("ended", "told"), [((0, 0), "no point is kept yet"), ((9, 2), "7 points are kept")]
)
def test_interrupt(file, tmp_path, monkeypatch, ended, told):
    def interrupted(points, folder, progress, **_):
        progress(*ended)
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "run_sweep", interrupted)
    result = call("sweep", file, "--grid", "seed=0:9:10", "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert result.stderr == f"thincam: interrupted; {told}. The same command goes on from there.\n"


_TWO = "[{beta: 25 /mm^2, distance: 3 mm}, {beta: 20 /mm^2, distance: 3 mm}]"


class TestExitCode2:
    @pytest.mark.parametrize(
        ("options", "part"),
        [
            (("--grid", "sed=0:4:5"), "--grid sed=0:4:5: sed: unknown key"),
            (("--grid", "methods.7.name=a"), "methods has no entry 7"),
            (("--grid", "mask.width=1:2:3 nms"), 'has the unknown unit "nms"'),
            # Of every entry that a * stands for, once.
            (
                ("--grid", "methods.*.shots.*.beta=7", "--set", f"methods.0.shots={_TWO}"),
                "methods[0].shots[0].beta and 1 more: 7 has no unit",
            ),
            (("--grid", "seed=1", "--workers", 1, "--scheduler", "tcp://a:1"), "leave it out"),
            (("--grid", "seed=1", "--set", "seed=x"), "--set seed=x: seed: 'x'"),
        ],
    )
    def test_options(self, file, tmp_path, options, part):
        out = tmp_path / "out"
        assert part in one_line(call("sweep", file, *options, "--out", out))
        assert not out.exists()

    def test_experiment_of_another_kind(self):
        file = ROOT / "configs" / "fza_refocus.yaml"
        line = one_line(call("sweep", file, "--grid", "seed=1"))
        assert line == f"{file}: is of kind refocus; a sweep takes a study"

    def test_missing_parts(self, file, monkeypatch):
        def without(name):
            return None if name in ("distributed", "pyarrow") else importlib.util.find_spec(name)

        monkeypatch.setattr(command, "find_spec", without)
        for options, missing in (
            ((), "pyarrow"),
            (("--scheduler", "tcp://a:1"), "distributed, pyarrow"),
        ):
            assert one_line(call("sweep", file, "--grid", "seed=1", *options)) == (
                f"thincam sweep needs {missing}; install them with pip install 'thincam_jax[sweep]'"
            )


def test_coarse_pixels_are_told_once(file, asked, tmp_path):
    out = tmp_path / "out"
    result = called("sweep", file, "--grid", "sensor.pitch=50,80,90 um", "--out", out)
    (line,) = result.stderr.splitlines()
    first = "warning: 2 of 3 points; the first (sensor.pitch=0.08): the mask casts 7.73 cycles/mm"
    assert line.startswith(f"thincam: {first}")
