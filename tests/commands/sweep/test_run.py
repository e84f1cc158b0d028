"""Whole sweeps: what ends up in the table whatever happens to points, workers and the command."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest
from commands.sweep import mini

from helpers import ROOT
from thincam_jax.commands.sweep import run
from thincam_jax.commands.sweep.point import Metrics
from thincam_jax.commands.sweep.run import SweepFolder, run_sweep
from thincam_jax.commands.sweep.workers import Died


@pytest.fixture
def config(tmp_path):
    return mini.study(tmp_path)


@pytest.fixture
def folder(config, tmp_path):
    folder = SweepFolder(tmp_path / "out")
    folder.claim(config)
    return folder


@pytest.fixture
def at_once(monkeypatch):
    """In place of workers: results in the order of the list; returns the keys that were done."""
    results, done = {}, []

    def outcomes(measure, tasks):
        for key in tasks:
            done.append(key)
            yield key, results.get(key, mini.outcome(1))

    monkeypatch.setattr(run, "workers_of", lambda *_: contextlib.nullcontext(outcomes))
    return results, done


def rows(path):
    return pq.read_table(path / "results.parquet").to_pylist()


def failures(path):
    text = (path / "failures.jsonl").read_text("utf-8")
    return {tuple(f["values"].values()): f["reason"] for f in map(json.loads, text.splitlines())}


def test_finished_points_are_not_done_again_and_failed_ones_are(config, folder, at_once):
    results, done = at_once
    points = mini.points(config, "seed=-1:3:5")
    results[points[2].key] = Metrics(None, "once")
    results[points[3].key] = Died()
    results[points[4].key] = ModuleNotFoundError("No module named 'thincam_jax'")
    told = []
    swept = run_sweep(points, folder, lambda *numbers: told.append(numbers))
    assert (swept.points, swept.rows, len(swept.failures)) == (5, 1, 4)
    assert told == [(0, 0), (1, 1), (2, 1), (3, 2), (4, 3), (5, 4)]
    assert failures(folder.path) == {
        (-1,): "--grid seed=-1:3:5: seed: -1: input should be greater than or equal to 0",
        (1,): "once",
        (2,): "worker died",
        (3,): "ModuleNotFoundError: No module named 'thincam_jax'",
    }
    results.clear()
    done.clear()
    told.clear()
    assert run_sweep(points, folder, lambda *numbers: told.append(numbers)).rows == 4
    assert done == [point.key for point in points[2:]]
    assert told[0] == (1, 0)
    assert list(failures(folder.path)) == [(-1,)]


def test_interrupt_keeps_what_has_ended(config, folder, at_once):
    def interrupt(ended, _):
        if ended == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(mini.points(config, "seed=0:5:6"), folder, interrupt)
    assert [row["seed"] for row in rows(folder.path)] == [0, 1]
    assert run_sweep(mini.points(config, "seed=0:5:6"), folder, mini.ignore).rows == 6


@pytest.mark.thorough
def test_workers_that_die_and_points_that_raise(config, folder, monkeypatch):
    """On two processes; the points beside those that kill their worker are not lost."""
    paths = (ROOT, ROOT / "tests", *filter(None, [os.environ.get("PYTHONPATH")]))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, paths)))
    swept = run_sweep(
        mini.points(config, "seed=0:7:8"),
        folder,
        mini.ignore,
        workers=2,
        measure=mini.deadly_measure,
    )
    assert (swept.points, swept.rows) == (8, 6)
    assert [row["psnr_db/single/star"] for row in rows(folder.path)] == [0, 1, 2, 5, 6, 7]
    assert failures(folder.path) == {(3,): "worker died", (4,): "ZeroDivisionError: four"}


def command(file: Path, out: Path, *grid: str) -> list[str]:
    return [
        *(
            sys.executable,
            "-m",
            "thincam_jax.commands.start",
            "sweep",
            str(file),
            "--out",
            str(out),
        ),
        *("--workers", "2", *(part for axis in grid for part in ("--grid", axis))),
    ]


def environment(file: Path) -> dict[str, str]:
    """Of a user without dask's workers, in float32. One sweep's compilations serve the next."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_ENABLE")}
    without = file.parent / "without"
    without.mkdir(exist_ok=True)
    # Not dask itself, which pint imports where it is installed.
    (without / "distributed.py").write_text(
        "raise ImportError('local sweeps do without')\n", "utf-8"
    )
    path = os.pathsep.join(filter(None, [str(without), str(ROOT), kept.get("PYTHONPATH")]))
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(file.parent / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        # jaxlib 0.10.1 takes its own preferences for features that the processor lacks, and says
        # so at everything it finds there: https://github.com/jax-ml/jax/issues/38445.
        "TF_CPP_MIN_LOG_LEVEL": "3",
    }
    return {**kept, **cache, "PYTHONPATH": path}


@pytest.mark.thorough
def test_ctrl_c_of_a_terminal(tmp_path):
    """It reaches the workers too, who keep silent; the rows are kept, and nobody stays behind."""
    file, out = mini.write(tmp_path), tmp_path / "out"
    process = subprocess.Popen(
        command(file, out, "seed=0:299:300"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(file),
        start_new_session=True,
    )
    while len(list(out.glob("points/*.parquet"))) < 5:
        assert process.poll() is None
        time.sleep(0.01)
    workers = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    kept = len(rows(out))
    assert kept >= 5
    assert errors.splitlines() == [
        f"thincam: interrupted; {kept} points are kept. The same command goes on from there."
    ]
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive
