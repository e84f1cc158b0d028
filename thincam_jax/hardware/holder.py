"""The process that holds the file of a device."""

import os
from contextlib import suppress
from pathlib import Path


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
