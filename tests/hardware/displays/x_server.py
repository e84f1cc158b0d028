"""An X server without a monitor, whose picture is read back; from Debian's xvfb."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import mss
import numpy as np
import pytest

SCREEN = 200, 320  # rows, columns
needs_x_server = pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Debian's xvfb")


@contextmanager
def x_server() -> Iterator[str]:
    """The server's name for DISPLAY; it listens on a socket of this machine only."""
    read, write = os.pipe()
    screen = f"{SCREEN[1]}x{SCREEN[0]}x24"
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", screen, "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as answer:
            yield f":{answer.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


def wrong_pixels(display, name: str, corner: tuple[int, int], frames: int = 20) -> int:
    """Random patterns, read from the screen as soon as `show` returns: pixels that differ."""
    random, wrong = np.random.default_rng(3), 0
    rows, columns = display.shape
    place = {"left": corner[1], "top": corner[0], "width": columns, "height": rows}
    with mss.MSS(display=name) as reader:
        for _ in range(frames):
            pattern = random.integers(0, 256, display.shape, dtype=np.uint8)
            display.show(pattern)
            seen = np.asarray(reader.grab(place))[..., :3]
            wrong += int(np.any(seen != pattern[..., None], axis=2).sum())
    return wrong
