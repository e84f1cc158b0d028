"""Workers of a dask scheduler that runs already."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import distributed
from distributed.scheduler import KilledWorker

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sweep.workers import Died, Outcomes

_CONNECT_SECONDS = 5


@contextlib.contextmanager
def scheduled_workers(address: str) -> Iterator[Outcomes]:
    """The workers of the scheduler at an address; results as of `local_workers`.

    **Errors**: ConfigError, one line, where no scheduler answers at the address, it has no workers
    or it goes away.
    """
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
            yield lambda function, tasks: _outcomes(client, function, tasks)


def _outcomes(
    client: distributed.Client, function: Callable, tasks: Mapping[str, tuple]
) -> Iterator[tuple[str, Any]]:
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
    async with distributed.rpc(address) as remote:
        return await remote.identity()


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
