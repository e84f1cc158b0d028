"""Workers and schedulers: those of another process, that are not there, and that go away."""

import logging
import socket

import distributed
import pytest

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sweep import cluster
from thincam_jax.commands.sweep.cluster import connected, outcomes


def fault(address):
    with pytest.raises(ConfigError) as caught, connected(address, None, 1):
        pass
    (line,) = str(caught.value).splitlines()
    return line


@pytest.fixture
def scheduler(monkeypatch):
    """A scheduler with no worker yet."""
    monkeypatch.setattr(cluster, "_CONNECT_SECONDS", 1)
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
    with connected(address, None, 1) as client:
        found = dict(outcomes(client, divmod, {"fine": (7, 2), "broken": (7, 0)}))
    assert found["fine"] == (3, 1)
    assert isinstance(found["broken"], ZeroDivisionError)
    scheduler.scale(0)


def test_nobody_answers(monkeypatch):
    monkeypatch.setattr(cluster, "_CONNECT_SECONDS", 0.5)
    level = logging.getLogger("distributed").level
    for address in ("tcp://127.0.0.1:1", "nonsense", "http://127.0.0.1:1", "tcp://"):
        line = fault(address)
        assert line.startswith(f"--scheduler {address}: no scheduler answers there; give the addr")
    assert logging.getLogger("distributed").level == level


def test_somebody_else_answers(monkeypatch):
    """A port that takes the connection and says nothing."""
    monkeypatch.setattr(cluster, "_CONNECT_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = fault(f"tcp://127.0.0.1:{server.getsockname()[1]}")
    assert ": no scheduler answers there; " in line
