"""An X server without a monitor, whose picture is read back; from Debian's xvfb."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mss
import numpy as np
import pytest

SCREEN = 200, 320  # rows, columns
needs_x_server = pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Debian's xvfb")
needs_two_monitors = pytest.mark.skipif(
    shutil.which("Xorg") is None
    or shutil.which("xrandr") is None
    or not Path("/usr/lib/xorg/modules/drivers/dummy_drv.so").exists(),
    reason="needs Debian's xserver-xorg-video-dummy and x11-xserver-utils",
)

MONITOR = 768, 1024
TWO_MONITORS = """
Section "Device"
    Identifier "device"
    Driver "dummy"
    VideoRam 64000
EndSection
Section "Monitor"
    Identifier "monitor"
    HorizSync 5-1000
    VertRefresh 5-200
EndSection
Section "Screen"
    Identifier "screen"
    Device "device"
    Monitor "monitor"
    DefaultDepth 24
    SubSection "Display"
        Depth 24
        Modes "1024x768"
        Virtual 2048 768
    EndSubSection
EndSection
"""


@contextmanager
def serving(*command: str) -> Iterator[str]:
    """The server's name for DISPLAY; it listens on a socket of this machine only."""
    read, write = os.pipe()
    server = subprocess.Popen(
        [*command, "-displayfd", str(write), "-nolisten", "tcp"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as answer:
            yield f":{answer.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


@contextmanager
def x_server() -> Iterator[str]:
    with serving("Xvfb", "-screen", "0", f"{SCREEN[1]}x{SCREEN[0]}x24") as name:
        yield name


@contextmanager
def x_server_of_two_monitors(folder: Path) -> Iterator[str]:
    """DUMMY0, and DUMMY1 to its right."""
    config = folder / "xorg.conf"
    config.write_text(TWO_MONITORS, "utf-8")
    log = str(folder / "xorg.log")
    with serving("Xorg", "-config", str(config), "-logfile", log, "-noreset") as name:
        for arguments in (
            ("--addmode", "DUMMY1", "1024x768"),
            ("--output", "DUMMY1", "--mode", "1024x768", "--right-of", "DUMMY0"),
            ("--query",),  # without it, clients do not see the second
        ):
            command = ["xrandr", "--display", name, *arguments]
            subprocess.run(command, check=True, capture_output=True)
        yield name


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
