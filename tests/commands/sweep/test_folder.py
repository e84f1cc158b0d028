"""The folder of a sweep: rows, failures, tables, and whose folder it is."""

import fcntl
import json

import pyarrow.parquet as pq
import pytest
from commands.sweep import mini

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.sweep.point import Metrics
from thincam_jax.commands.sweep.run import SweepFolder


@pytest.fixture
def config(tmp_path):
    return mini.study(tmp_path)


@pytest.fixture
def folder(config, tmp_path):
    folder = SweepFolder(tmp_path / "deep" / "out")
    folder.claim(config)
    return folder


def rows(folder):
    return pq.read_table(folder.path / "results.parquet").to_pylist()


def count(table):
    return 0 if table is None else table.num_rows


def failures(folder):
    text = (folder.path / "failures.jsonl").read_text("utf-8")
    return [json.loads(line) for line in text.splitlines()]


def test_rows_are_in_the_order_of_the_grid_and_failures_apart(folder, config):
    points = mini.points(config, "seed=0:3:4")
    folder.keep(points[2], mini.outcome(20))
    folder.keep(points[0], mini.outcome(10))
    folder.keep(points[1], Metrics(None, "why", "Traceback"))
    assert [folder.has(point) for point in points] == [True, False, True, False]
    assert count(folder.collect(points)[0]) == 2
    assert [list(row) for row in rows(folder)] == [
        ["seed", "point", "psnr_db/single/star", "seconds"]
    ] * 2
    assert [(r["seed"], r["point"], r["psnr_db/single/star"]) for r in rows(folder)] == [
        (0, points[0].key, 10.0),
        (2, points[2].key, 20.0),
    ]
    (failure,) = failures(folder)
    assert failure == {
        "point": points[1].key,
        "values": {"seed": 1},
        "reason": "why",
        "traceback": "Traceback",
    }
    assert not list(folder.path.rglob("*.partial"))


def test_failure_goes_when_the_point_succeeds(folder, config):
    points = mini.points(config, "seed=0:1:2")
    folder.keep(points[0], Metrics(None, "why"))
    assert folder.collect(points) == (None, failures(folder))
    assert not (folder.path / "results.parquet").exists()
    folder.keep(points[0], mini.outcome(1))
    table, failed = folder.collect(points)
    assert (count(table), failed) == (1, [])
    assert not (folder.path / "failures.jsonl").exists()


def test_row_that_cannot_be_read_does_not_count(folder, config):
    (point,) = mini.points(config, "seed=1")
    folder.keep(point, mini.outcome(1))
    (part,) = (folder.path / "points").iterdir()
    for content in (part.read_bytes()[:100], b""):
        part.write_bytes(content)
        assert not folder.has(point)
        assert folder.collect([point]) == (None, [])


def test_other_grid_takes_the_rows_that_it_shares(folder, config):
    """An axis more or less: the values are those of the grid that is asked for."""
    first = mini.points(config, "seed=0:2:3", "noise.snr_db=20,30")
    for number, point in enumerate(first):
        folder.keep(point, mini.outcome(number))
    second = mini.points(config, "seed=0:4:5")
    folder.collect(second)
    assert [(row["seed"], row["psnr_db/single/star"]) for row in rows(folder)] == [
        (0, 1.0),
        (1, 3.0),
        (2, 5.0),
    ]
    assert "noise.snr_db" not in rows(folder)[0]


def test_columns_that_some_rows_lack(folder, config):
    """A row without a resolved element, one without a PSNR, values of several kinds."""
    points = mini.points(config, "sensor.bit_depth=null,8", "sensor.exposure=0.9")
    folder.keep(points[0], Metrics({"psnr_db/a/b": None, "resolved_group/a/b": 0, "seconds": 1.0}))
    folder.keep(points[1], Metrics({"psnr_db/a/b": None, "seconds": 1.0}))
    folder.collect(points)
    first, second = rows(folder)
    assert (first["sensor.bit_depth"], second["sensor.bit_depth"]) == (None, 8)
    assert (first["resolved_group/a/b"], second["resolved_group/a/b"]) == (0, None)
    table = pq.read_table(folder.path / "results.parquet")
    assert str(table.schema.field("psnr_db/a/b").type) == "double"
    assert table.column_names[-1] == "seconds"


def test_first_start_that_was_killed(config, tmp_path):
    """Between the neighbour that was written and its renaming."""
    folder = SweepFolder(tmp_path / "killed")
    folder.path.mkdir()
    (folder.path / ".0123.partial").write_text("na", encoding="utf-8")
    folder.claim(config)
    assert load_experiment(folder.path / "study.yaml") == config


def test_a_second_run_is_refused_while_the_first_lives(config, tmp_path):
    folder = SweepFolder(tmp_path / "out")
    folder.path.mkdir()
    with (folder.path / ".lock").open("w") as other:  # of another process
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(ConfigError, match="another sweep writes to it; wait for its end or"):
            folder.claim(config)
        fcntl.flock(other, fcntl.LOCK_UN)
        folder.claim(config)
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    folder.claim(config)  # by the same process
