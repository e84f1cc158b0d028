"""Worker processes, on this machine or of a scheduler that runs already."""

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from multiprocessing import resource_tracker
from typing import Any

import distributed
from dask import config as settings
from dask.system import CPU_COUNT
from distributed.scheduler import KilledWorker
from distributed.utils import LoopRunner

from thincam_jax.commands.config_file import ConfigError

_CONNECT_SECONDS = 5


class Died:
    """In place of a result: the worker process ended while it computed."""


@contextlib.contextmanager
def connected(
    scheduler: str | None, workers: int | None, most: int
) -> Iterator[distributed.Client]:
    """A client of the scheduler at an address, or of new workers here; closed at the end.

    `most` is how many tasks there are: no more workers are started here, and by default as many as
    cores.

    **Errors**: ConfigError, one line, where no scheduler answers at the address, or it has no
    workers.
    """
    with _quiet(), contextlib.ExitStack() as stack:
        if scheduler is not None:
            yield stack.enter_context(_connect(scheduler))
            return
        count = min(workers or CPU_COUNT, most)
        own = {
            # One that dies is not given to another at once: `outcomes` tries it again on its own.
            "distributed.scheduler.allowed-failures": 0,
            "distributed.scheduler.worker-saturation": 1.0,
        }
        stack.enter_context(settings.set(own))
        cluster = stack.enter_context(
            distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,  # pyright: ignore[reportArgumentType]
                # Even without its pages the scheduler opens a port, which another sweep may have.
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                memory_limit=None,
                silence_logs=logging.CRITICAL,
                env=_environment(max(1, CPU_COUNT // count)),
                loop=stack.enter_context(_loop()),
            )
        )
        yield stack.enter_context(distributed.Client(cluster, set_as_default=False))


def outcomes(
    client: distributed.Client, function: Callable, tasks: Mapping[str, tuple]
) -> Iterator[tuple[str, Any]]:
    """(name, result) of function(*arguments) for every task, in the order in which they end.

    The result is an exception where the function raised one or could not be sent. A task whose
    worker died is done once more when no other is under way; then it is `Died`, for the death is
    its own.

    **Errors**: ConfigError where the scheduler goes away.
    """
    suspects = []
    for name, result in _all(client, function, tasks):
        if isinstance(result, Died):
            suspects.append(name)
        else:
            yield name, result
    for name in suspects:
        yield from _all(client, function, {name: tasks[name]})


def _all(client, function: Callable, tasks: Mapping[str, tuple]) -> Iterator[tuple[str, Any]]:
    futures = {
        client.submit(function, *arguments, pure=False): name for name, arguments in tasks.items()
    }
    for future in distributed.as_completed(list(futures), loop=client.loop):
        name = futures.pop(future)
        if future.cancelled():
            raise ConfigError("the scheduler is gone; the same command goes on from there")
        error = future.exception()
        if isinstance(error, KilledWorker):
            yield name, Died()
        else:
            yield name, future.result() if error is None else error


@contextlib.contextmanager
def _connect(address: str) -> Iterator[distributed.Client]:
    asked = f"--scheduler {address}"
    try:
        # Asked first: a client that finds none keeps trying, also while it is closed.
        found = asyncio.run(asyncio.wait_for(_identity(address), _CONNECT_SECONDS))
    except Exception:  # whatever answers there, it is no scheduler
        found = {}
    if found.get("type") != "Scheduler":
        raise ConfigError(
            f"{asked}: no scheduler answers there; give the address that 'dask scheduler' prints, "
            "such as tcp://192.168.0.2:8786"
        )
    with distributed.Client(address, timeout=_CONNECT_SECONDS, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
        except TimeoutError:
            raise ConfigError(
                f"{asked}: has no workers; start some with 'dask worker {address}'"
            ) from None
        yield client


async def _identity(address: str) -> Any:
    async with distributed.rpc(address) as remote:
        return await remote.identity()


@contextlib.contextmanager
def _loop() -> Iterator[Any]:
    """A running event loop that starts processes which Ctrl-C does not reach.

    A terminal sends it to all processes of the command; they would all print where they were. The
    command's own process closes the workers. A process inherits its blocked signals from the
    thread that starts it.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield None
        return
    runner = LoopRunner(asynchronous=False)
    _start_tracker()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        runner.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    try:
        yield runner.loop
    finally:
        runner.stop()


def _start_tracker() -> None:
    """Start the process of the standard library that cleans up after others.

    Starting it later would unblock Ctrl-C in the thread that starts the workers, and it warns of
    what an interrupted command has left to it.
    """
    sys.warnoptions.append("ignore::UserWarning:multiprocessing.resource_tracker")
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.pop()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the log of distributed, which tells of each worker that dies or restarts."""
    names = [n for n in logging.root.manager.loggerDict if n.split(".")[0] == "distributed"]
    levels = {name: logging.getLogger(name).level for name in ("distributed", *names)}
    for name in levels:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def _environment(threads: int) -> dict[str, str]:
    """Of a worker: `threads` for XLA and BLAS each, and no memory of a GPU taken in advance."""
    names = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    wanted = {**dict.fromkeys(names, str(threads)), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return {name: os.environ.get(name, value) for name, value in wanted.items()}
