"""Worker processes on this machine. Tasks and results go through pipes: no port is opened."""

import contextlib
import os
import pickle
import queue
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from thincam_jax._core.environment import usable_cores

# From a function and the arguments of each task by name: (name, result) in the order in which the
# tasks end.
Outcomes = Callable[[Callable, Mapping[str, tuple]], Iterator[tuple[str, Any]]]


class Died:
    """In place of a result: the worker process ended while it computed."""


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
    """What a worker does: a task at a time from standard input, until its other end is closed."""
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
    """Of a worker: `threads` for XLA and BLAS each, and no memory of a GPU taken in advance."""
    names = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    wanted = {**dict.fromkeys(names, str(threads)), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return {**wanted, **os.environ}
