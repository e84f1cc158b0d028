"""Schedulers: one of another process, one without workers, and what is none."""

import logging

import distributed
import pytest

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sweep import workers as schedulers
from thincam_jax.commands.sweep.workers import scheduled_workers


def fault(address):
    with pytest.raises(ConfigError) as caught, scheduled_workers(address):
        pass
    (line,) = str(caught.value).splitlines()
    return line


@pytest.fixture
def scheduler(monkeypatch):
    """A scheduler with no worker yet."""
    monkeypatch.setattr(schedulers, "_CONNECT_SECONDS", 1)
    with distributed.LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        processes=False,
        protocol="tcp://",
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
    ) as found:
        yield found


def test_scheduler_that_runs_already(scheduler):
    address = scheduler.scheduler_address
    assert fault(address) == (
        f"--scheduler {address}: has no workers; start some with 'dask worker {address}'"
    )
    scheduler.scale(1)
    with scheduled_workers(address) as outcomes:
        found = dict(outcomes(divmod, {"fine": (7, 2), "broken": (7, 0)}))
    assert found["fine"] == (3, 1)
    assert isinstance(found["broken"], ZeroDivisionError)
    scheduler.scale(0)


def test_nobody_answers(monkeypatch):
    monkeypatch.setattr(schedulers, "_CONNECT_SECONDS", 0.5)
    level = logging.getLogger("distributed").level
    for address in ("tcp://127.0.0.1:1", "nonsense", "http://127.0.0.1:1", "tcp://"):
        line = fault(address)
        assert line.startswith(f"--scheduler {address}: no scheduler answers there; give the addr")
    assert logging.getLogger("distributed").level == level
