"""`AravisCamera` on the fake camera that comes with aravis, over the network of this machine."""

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.base import (
    Busy,
    Disconnected,
    IncompleteFrame,
    NotFound,
    OutOfRange,
    Region,
    Timeout,
)
from thincam_jax.hardware.cameras.aravis import AravisCamera
from thincam_jax.hardware.registry import open_device

FAKE = "arv-fake-gv-camera-0.8"
needs_aravis = pytest.mark.skipif(
    shutil.which(FAKE) is None or find_spec("gi") is None,
    reason="needs Debian's aravis-tools, gir1.2-aravis-0.8 and python3-gi (or PyGObject<3.51)",
)
SERIAL = "THINCAM1"
# At 10 ms the fake camera shows (x + y + count) mod 255.
SETTINGS = CameraSettings(1e-2, Region(6, 10, 48, 300), "Mono8")
TIMEOUT = 1.0


class FakeCamera:
    """The process of aravis's fake camera; `lost` is the part of packets that it drops, in ‰."""

    def __init__(self):
        self.process = None

    def start(self, lost=0):
        command = [FAKE, "-i", "127.0.0.1", "-s", SERIAL, "-r", str(lost)]
        self.process = subprocess.Popen(command)
        time.sleep(0.3)  # one that is found while it starts never sends a frame
        return self.open()

    def open(self):
        """Once it answers, which takes it a moment."""
        deadline = time.monotonic() + 10
        while True:
            try:
                return open_device("cameras", "aravis", {"name": f"Aravis-Fake-{SERIAL}"})
            except NotFound:
                if time.monotonic() > deadline:
                    raise

    def stop(self):
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def fake():
    fake = FakeCamera()
    yield fake
    fake.stop()


def count_shown(pixels):
    """The count of a frame, if every pixel is right."""
    y, x = np.indices(pixels.shape)
    counts = np.unique((pixels.astype(int) - x - y) % 255)
    assert counts.size == 1
    return counts[0]


def test_without_aravis_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gi", None)
    with pytest.raises(NotFound, match="apt-get install gir1.2-aravis-0.8"):
        open_device("cameras", "aravis")


@needs_aravis
def test_frames_and_settings(fake):
    with fake.start() as camera:
        assert camera.identity.serial == SERIAL and camera.sensor_shape == (2048, 2048)
        assert {"name": f"Aravis-Fake-{SERIAL}"} in [
            one.options for one in AravisCamera.connected()
        ]
        assert camera.configure(SETTINGS) == SETTINGS
        frames = [camera.trigger_and_grab(TIMEOUT) for _ in range(4)]
        shown = [count_shown(frame.pixels) for frame in frames]
        assert np.all(np.diff(shown) % 255 == np.diff([frame.number for frame in frames]))
        assert [frame.number for frame in frames] == [0, 1, 2, 3]
        for refused in (
            CameraSettings(1e3, None, "Mono8"),
            CameraSettings(1e-2, None, "Mono12"),
            CameraSettings(1e-2, Region(0, 0, 2049, 1), "Mono8"),
        ):
            with pytest.raises(OutOfRange):
                camera.configure(refused)
        sixteen = camera.configure(CameraSettings(1e-2, Region(0, 0, 2, 2048), "Mono16"))
        frame = camera.trigger_and_grab(TIMEOUT)
        assert (frame.number, frame.bit_depth, frame.pixels.dtype) == (4, 16, np.uint16)
        assert sixteen.region is not None and frame.pixels.shape == (2, 2048)
        assert camera.configure(replace(SETTINGS, trigger="Line0")).trigger == "Line0"
        with pytest.raises(Timeout, match="is the trigger connected to Line0"):
            camera.trigger_and_grab(0.1)
        camera._features.set("TriggerMode", "Off")  # frames without pulses, in their place
        assert [camera.trigger_and_grab(TIMEOUT).number for _ in range(2)] == [5, 6]


@needs_aravis
@pytest.mark.thorough  # aravis waits for 2.5 s, several times, before it gives a camera up
def test_a_camera_that_is_held_missing_or_gone(fake):
    with fake.start() as camera:
        camera.configure(SETTINGS)
        camera.trigger_and_grab(TIMEOUT)
        with pytest.raises(Busy):
            fake.open()
        with pytest.raises(NotFound, match=SERIAL):
            open_device("cameras", "aravis", {"name": "none such"})
        fake.stop()
        with pytest.raises(Disconnected):
            camera.trigger_and_grab(TIMEOUT)


@needs_aravis
def test_packet_loss_of_one_percent_gives_no_wrong_frame(fake):
    whole, lost, last = 0, 0, None
    with fake.start(lost=10) as camera:
        camera.configure(SETTINGS)
        for _ in range(60):
            try:
                frame = camera.trigger_and_grab(0.3)
            except (IncompleteFrame, Timeout):
                lost, last = lost + 1, None
                continue
            shown = count_shown(frame.pixels)
            if last is not None:  # within a stream the numbers are the camera's own
                assert (shown - last[0]) % 255 == frame.number - last[1]
            whole, last = whole + 1, (shown, frame.number)
    assert whole > 20 and lost > 0
