"""The process that holds a device: by a lock of this package's own, or by the device's file."""

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock
from filelock import Timeout as LockTimeout

from thincam_jax._core.files import read_regular, write_whole
from thincam_jax.hardware.base import Busy


@contextmanager
def held(device: str) -> Iterator[None]:
    """Keep this user's other processes from opening a device, by its name, meanwhile.

    The lock ends with the process, however that ends. Where none can be written, the driver's own
    refusal remains.

    **Errors**: Busy, which names the process that holds it, and since when.
    """
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".cache") / "thincam_jax"
    place = folder / f"device-{hashlib.sha256(device.encode()).hexdigest()[:16]}"
    lock = FileLock(place.with_suffix(".lock"))
    now = datetime.now().astimezone()
    program = f"{Path(sys.argv[0]).name} (process {os.getpid()})"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        write_whole(place, f"{program} has held it since {now:%H:%M:%S}")
    except LockTimeout as error:
        cause = "another process holds it"
        with suppress(OSError):  # it is about to write who it is
            cause = read_regular(place).decode("utf-8", "replace")
        raise Busy(device, "open", cause, "end that process, or wait for it") from error
    except OSError:
        pass
    try:
        yield
    finally:
        lock.release()


def holder(path: str, *, others: bool = False) -> str:
    """Name and number of a process that has a file open; "another program" where unknown.

    `others`: ignore this process.
    """
    wanted = os.path.realpath(path)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # another user's process, or one that has ended
            own = others and process.name == str(os.getpid())
            files = () if own else (process / "fd").iterdir()
            if any(os.path.realpath(file) == wanted for file in files):
                return f"{(process / 'comm').read_text('utf-8').strip()} (process {process.name})"
    return "another program"
