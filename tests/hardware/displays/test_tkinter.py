"""`TkinterDisplay` on an X server whose picture is read back."""

import os
import subprocess
import sys

import pytest
from hardware.displays.x_server import SCREEN, needs_x_server, x_server

from helpers import ROOT
from thincam_jax.hardware.base import NotFound
from thincam_jax.hardware.registry import open_device

pytest.importorskip("tkinter", reason="needs a Python with tkinter (Debian's python3-tk)")


def test_without_a_desktop(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(NotFound, match="set DISPLAY"):
        open_device("displays", "tkinter")


# Tk keeps its connection and ends the process when the server does, hence one of its own.
SCRIPT = """
import sys
import numpy as np
from hardware.displays.x_server import wrong_pixels
from thincam_jax.hardware import Disconnected, open_device

options, shape, name = eval(sys.argv[1]), eval(sys.argv[2]), sys.argv[3]
with open_device("displays", "tkinter", options) as display:
    assert display.shape == shape
    assert wrong_pixels(display, name, (options.get("top", 0), options.get("left", 0))) == 0
    display.close()
    try:
        display.show(np.zeros(shape, np.uint8))
    except Disconnected:
        print("as expected")
"""


@pytest.mark.thorough
@needs_x_server
@pytest.mark.parametrize("options", [{}, {"left": 30, "top": 20, "size": (24, 40)}])
def test_no_wrong_pixel_on_an_x_server(options):
    with x_server() as name:
        path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
        environment = {**os.environ, "DISPLAY": name, "PYTHONPATH": path}
        arguments = repr(options), repr(options.get("size", SCREEN)), name
        ran = subprocess.run(
            [sys.executable, "-c", SCRIPT, *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert ran.stdout.strip() == "as expected", ran.stderr
