"""`SdlDisplay` on SDL's dummy driver, which writes each frame to a file, and on an X server."""

import numpy as np
import pytest
from hardware.displays.x_server import (
    MONITOR,
    SCREEN,
    needs_two_monitors,
    needs_x_server,
    wrong_pixels,
    x_server,
    x_server_of_two_monitors,
)
from PIL import Image

from thincam_jax.hardware.base import Disconnected, NotFound, OutOfRange
from thincam_jax.hardware.registry import open_device

SIZE = 24, 40
RANDOM = np.random.default_rng(1)


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """Where the dummy driver writes what it presents."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_VIDEO_DUMMY_SAVE_FRAMES", "1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def presented(folder):
    """The last frame, and none of those before is left."""
    files = sorted(folder.glob("*.bmp"))
    frame = np.asarray(Image.open(files[-1]).convert("RGB"))
    for file in files:
        file.unlink()
    return frame


def test_every_pixel_is_presented_when_show_returns(folder):
    with open_device("displays", "sdl", {"size": SIZE}) as display:
        assert display.shape == SIZE and display.identity.version == "dummy"
        for _ in range(5):
            pattern = RANDOM.integers(0, 256, SIZE, dtype=np.uint8)
            display.show(pattern)
            assert np.array_equal(presented(folder), np.repeat(pattern[..., None], 3, axis=2))


def test_all_of_a_monitor_by_its_name_or_number(folder):
    for monitor in ("", "0"):
        with open_device("displays", "sdl", {"monitor": monitor}) as display:
            assert display.shape == (768, 1024)
    with pytest.raises(NotFound, match="found: 0 '0'"):
        open_device("displays", "sdl", {"monitor": "HDMI-1"})


def test_what_cannot_be_shown(folder, monkeypatch):
    with open_device("displays", "sdl", {"size": SIZE}) as display:
        for pattern in (np.zeros((40, 24), np.uint8), np.zeros(SIZE)):
            with pytest.raises(OutOfRange, match=r"uint8 levels of shape \(24, 40\)"):
                display.show(pattern)
        display.close()
        with pytest.raises(Disconnected):
            display.show(np.zeros(SIZE, np.uint8))
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    with pytest.raises(NotFound, match="connect a monitor"):
        open_device("displays", "sdl")


@needs_x_server
@pytest.mark.parametrize("size", [None, SIZE])
def test_no_wrong_pixel_on_an_x_server(size, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    with x_server() as name:
        monkeypatch.setenv("DISPLAY", name)
        with open_device("displays", "sdl", {"size": size}) as display:
            assert display.shape == (size or SCREEN)
            assert wrong_pixels(display, name, (0, 0)) == 0


@needs_two_monitors
@pytest.mark.thorough
def test_the_monitor_that_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    with x_server_of_two_monitors(tmp_path) as name:
        monkeypatch.setenv("DISPLAY", name)
        with pytest.raises(NotFound, match="found: 0 'DUMMY0', 1 'DUMMY1'"):
            open_device("displays", "sdl")
        for monitor, left in (("DUMMY1", MONITOR[1]), ("DUMMY0", 0), ("1", MONITOR[1])):
            with open_device("displays", "sdl", {"monitor": monitor}) as display:
                assert display.shape == MONITOR
                assert wrong_pixels(display, name, (0, left), frames=5) == 0
