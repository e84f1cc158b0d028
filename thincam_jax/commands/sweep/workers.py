"""Worker processes on this machine, or workers of a dask scheduler that runs already.

Tasks and results of this machine's go through pipes: no port is opened.
"""

import asyncio
import contextlib
import logging
import os
import pickle
import queue
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TYPE_CHECKING, Any

from thincam_jax._core.environment import usable_cores
from thincam_jax.commands.config_file import ConfigError

if TYPE_CHECKING:
    import distributed

_CONNECT_SECONDS = 5  # to a scheduler

# From a function and the arguments of each task by name: (name, result) in the order in which the
# tasks end.
Outcomes = Callable[[Callable, Mapping[str, tuple]], Iterator[tuple[str, Any]]]


# Called with the numbers of tasks that have ended and that have failed.
Progress = Callable[[int, int], object]


class Died:
    """Placeholder for a result whose worker process ended while it computed."""


def tried_twice(
    outcomes: Outcomes, measure: Callable, tasks: Mapping[str, tuple]
) -> Iterator[tuple[str, Any]]:
    """A task whose worker died is done once more when no other is under way.

    If that dies too, the death is the task's own: not of a memory that others had filled.
    """
    suspects = []
    for name, result in outcomes(measure, tasks):
        if isinstance(result, Died):
            suspects.append(name)
        else:
            yield name, result
    for name in suspects:
        yield from outcomes(measure, {name: tasks[name]})


def workers_of(
    scheduler: str | None, workers: int | None, tasks: int
) -> contextlib.AbstractContextManager[Outcomes]:
    """Workers of a scheduler's address, or so many new processes."""
    return local_workers(workers, tasks) if scheduler is None else scheduled_workers(scheduler)


@contextlib.contextmanager
def local_workers(workers: int | None, tasks: int) -> Iterator[Outcomes]:
    """New processes, by default one for each core and never more than tasks; killed at the end.

    A result is an exception where the function raised one or cannot be imported by a worker, and
    `Died` where the worker died. The next task then gets a new one.
    """
    count = min(workers or usable_cores(), tasks)
    environment = _environment(max(1, usable_cores() // count))
    idle: queue.SimpleQueue[subprocess.Popen | None] = queue.SimpleQueue()
    for _ in range(count):
        idle.put(None)  # one that is to be started
    started: list[subprocess.Popen] = []
    pool = ThreadPoolExecutor(count)  # a thread waits for each worker

    def result_of(task: tuple) -> Any:
        worker = idle.get()
        if worker is None:
            worker = _start(environment)
            started.append(worker)
        result = _ask(worker, task)
        idle.put(None if isinstance(result, Died) else worker)
        return result

    def outcomes(function: Callable, tasks: Mapping[str, tuple]) -> Iterator[tuple[str, Any]]:
        named = {pool.submit(result_of, (function, task)): name for name, task in tasks.items()}
        for future in as_completed(list(named)):
            yield named.pop(future), future.result()

    try:
        yield outcomes
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in started:
            with contextlib.suppress(OSError), worker:  # closes its pipes, and waits for it
                worker.kill()
        pool.shutdown()


def _start(environment: dict[str, str]) -> subprocess.Popen:
    """A process of a session of its own, so that the Ctrl-C of a terminal does not reach it."""
    return subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import serve; serve()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )


def _ask(worker: subprocess.Popen, task: tuple) -> Any:
    assert worker.stdin and worker.stdout
    try:
        pickle.dump(pickle.dumps(task), worker.stdin)
        worker.stdin.flush()
        return pickle.loads(pickle.load(worker.stdout))
    except (EOFError, OSError, ValueError, pickle.UnpicklingError):  # of a closed or cut pipe
        return Died()


def serve() -> None:
    """Do the tasks from standard input one at a time, until its other end is closed."""
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a task prints is no result
    with contextlib.suppress(EOFError):
        while True:
            pickle.dump(_answer(pickle.load(sys.stdin.buffer)), results)
            try:
                results.flush()
            except BrokenPipeError:  # the command was killed
                os._exit(1)


def _answer(task: bytes) -> bytes:
    try:
        function, arguments = pickle.loads(task)
        return pickle.dumps(function(*arguments))
    except Exception as error:
        return pickle.dumps(error)


def _environment(threads: int) -> dict[str, str]:
    """Environment of a worker: `threads` for XLA and BLAS each, no GPU memory taken in advance."""
    names = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    wanted = {**dict.fromkeys(names, str(threads)), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return {**wanted, **os.environ}


@contextlib.contextmanager
def scheduled_workers(address: str) -> Iterator[Outcomes]:
    """The workers of the scheduler at an address; results as of `local_workers`.

    **Errors**: ConfigError, one line, where no scheduler answers at the address, it has no workers
    or it goes away.
    """
    import distributed

    asked = f"--scheduler {address}"
    with _quiet():
        try:
            # Asked first: a client that finds none keeps trying, also while it is closed.
            found = asyncio.run(asyncio.wait_for(_identity(address), _CONNECT_SECONDS))
        except Exception:  # whatever answers there, it is no scheduler
            found = {}
        if found.get("type") != "Scheduler":
            raise ConfigError(
                f"{asked}: no scheduler answers there; give the address that 'dask scheduler' "
                "prints, such as tcp://192.168.0.2:8786"
            )
        with distributed.Client(address, timeout=_CONNECT_SECONDS, set_as_default=False) as client:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
            except TimeoutError:
                raise ConfigError(
                    f"{asked}: has no workers; start some with 'dask worker {address}'"
                ) from None
            yield lambda function, tasks: _scheduled(client, function, tasks)


def _scheduled(
    client: "distributed.Client", function: Callable, tasks: Mapping[str, tuple]
) -> Iterator[tuple[str, Any]]:
    import distributed
    from distributed.scheduler import KilledWorker

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


async def _identity(address: str) -> Any:
    import distributed

    async with distributed.rpc(address) as remote:
        return await remote.identity()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the log of distributed, which tells of each worker that dies or restarts."""
    names = [n for n in logging.root.manager.loggerDict if n.split(".")[0] == "distributed"]
    levels = {name: logging.getLogger(name).level for name in ("distributed", *names)}
    for name in levels:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
