"""`PylonCamera` on the emulator that Basler ships, as it is and fed with frames."""

from dataclasses import replace

import numpy as np
import pytest

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.base import (
    Disconnected,
    IncompleteFrame,
    NotFound,
    OutOfRange,
    Region,
    Timeout,
)
from thincam_jax.hardware.registry import open_device
from thincam_jax.hardware.virtual.devices import Faults
from thincam_jax.hardware.virtual.pylon import VirtualPylonCamera
from thincam_jax.hardware.virtual.rig import bits_of

SENSOR = 24, 40
SETTINGS = CameraSettings(exposure=1e-3, region=Region(4, 8, 12, 20))
TIMEOUT = 2.0  # s


class Scene:
    """Random counts, a new frame at each exposure."""

    def __init__(self):
        self.random, self.shown = np.random.default_rng(5), np.zeros(0)

    def expose(self, settings: CameraSettings) -> np.ndarray:
        region, bits = settings.region, bits_of(settings)
        assert region is not None
        shape = region.height, region.width
        self.shown = self.random.integers(0, 2**bits, shape).astype(np.uint16)
        return self.shown


@pytest.fixture
def scene():
    return Scene()


@pytest.fixture
def faults():
    return Faults()


@pytest.fixture
def camera(scene, faults):
    with VirtualPylonCamera(scene.expose, SENSOR, faults) as camera:
        camera.configure(SETTINGS)
        yield camera


def test_the_vendors_emulator_says_what_it_is_set_to(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    with open_device("cameras", "pylon", {"serial": "0815-0000"}) as camera:
        assert camera.identity.vendor == "Basler" and camera.identity.serial == "0815-0000"
        assert camera.sensor_shape == (4096, 4096)
        asked = CameraSettings(0.0123456789, Region(3, 5, 7, 11), "Mono12", gain=6.0)
        actual = camera.configure(asked)
        assert actual.region == asked.region and actual.pixel_format == "Mono12"
        assert actual.exposure == pytest.approx(asked.exposure, abs=1e-6)
        assert actual.gain == pytest.approx(6.0, abs=0.1) and actual.gain != 6.0
        frames = [camera.trigger_and_grab(TIMEOUT) for _ in range(3)]
        assert [frame.number for frame in frames] == [0, 1, 2]
        assert frames[0].pixels.shape == (7, 11) and frames[0].bit_depth == 12
        assert frames[0].exposure == actual.exposure


@pytest.mark.parametrize(
    "pixel_format",
    [f"{colour}{bits}" for colour in ("Mono", "BayerRG", "BayerGB") for bits in (8, 10, 12, 16)],
)
def test_frames_are_exact(camera, scene, pixel_format):
    camera.configure(CameraSettings(1e-3, SETTINGS.region, pixel_format))
    frames, shown = [], []
    for _ in range(4):
        frames.append(camera.trigger_and_grab(TIMEOUT))
        shown.append(scene.shown)
    for frame, counts in zip(frames, shown, strict=True):  # each has memory of its own
        assert np.array_equal(frame.pixels, counts)
    assert pixel_format.endswith(str(frames[0].bit_depth))


def test_binning_and_black_level_are_set_and_read_back(camera, scene):
    taken = camera.configure(CameraSettings(1e-3, binning=2, black_level=64.0))
    assert (taken.binning, taken.black_level) == (2, pytest.approx(64.0, abs=1.0))
    assert taken.region == Region(0, 0, 12, 20)
    assert np.array_equal(camera.trigger_and_grab(TIMEOUT).pixels, scene.shown)
    with pytest.raises(OutOfRange, match="a part of 12 × 20"):
        camera.configure(CameraSettings(1e-3, Region(0, 0, 24, 40), binning=2))
    assert camera.configure(CameraSettings(1e-3, Region(0, 0, 24, 40))).binning == 1
    assert camera.configure(CameraSettings(1e-3)).black_level == taken.black_level  # left as it is


def test_a_camera_that_renames_its_format_at_an_odd_place_is_seen(camera, monkeypatch):
    def renamed(name):
        odd = name == "PixelFormat" and camera._features.get("OffsetX") % 2
        return "BayerGR12" if odd else plain(name)

    plain = camera._features.get
    monkeypatch.setattr(camera._features, "get", renamed)
    even = CameraSettings(1e-3, Region(2, 4, 8, 12), "BayerRG12")
    assert camera.configure(even).bayer == "RGGB"
    with pytest.raises(OutOfRange, match="its format is BayerGR12; give an even top and left"):
        camera.configure(CameraSettings(1e-3, Region(2, 5, 8, 12), "BayerRG12"))


@pytest.mark.parametrize(
    ("settings", "allowed"),
    [
        (CameraSettings(100.0), "1e-06 … 10 s"),
        (CameraSettings(1e-3, Region(0, 0, 25, 40)), "24 × 40"),
        (CameraSettings(1e-3, Region(0, 39, 2, 2)), "24 × 40"),
        (CameraSettings(1e-3, pixel_format="RGB8"), "Mono8, Mono10, Mono12, Mono16, BayerGR8"),
        (CameraSettings(1e-3, binning=5), "BinningHorizontal of 5; give 1 … 4"),
        (CameraSettings(1e-3, black_level=2e3), "BlackLevel of 2000; give 0 … 1023"),
        (CameraSettings(1e-3, pixel_format="BayerRG8", binning=2), "give binning 1"),
        (CameraSettings(1e-3, gain=100.0), "0 … 48 dB"),
        (CameraSettings(1e-3, trigger="Line9"), "no trigger source Line9; give one of Software, L"),
    ],
)
def test_what_the_camera_lacks_is_refused_before_anything_is_written(camera, settings, allowed):
    with pytest.raises(OutOfRange, match=allowed):
        camera.configure(settings)
    assert camera.trigger_and_grab(TIMEOUT).pixels.shape == (12, 20)


def test_frames_at_a_line_are_awaited(camera, scene):
    """The emulator has no pulses: it runs freely, behind the driver's back, in their place."""
    taken = camera.configure(replace(SETTINGS, trigger="Line1"))
    assert taken.trigger == "Line1" and camera._features.get("TriggerMode") == "On"
    with pytest.raises(Timeout, match="no frame within 0.101 s; is the .* connected to Line1[?]"):
        camera.trigger_and_grab(0.1)
    camera._features.set("TriggerMode", "Off")
    camera._put(scene.expose(taken), 12)
    assert [camera.trigger_and_grab(TIMEOUT).number for _ in range(3)] == [0, 1, 2]
    camera._features.set("TriggerMode", "On")
    assert camera.configure(SETTINGS).trigger == "Software"
    assert camera.trigger_and_grab(TIMEOUT).number == 3


def test_unknown_camera_and_no_settings(monkeypatch, scene):
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    with pytest.raises(NotFound, match="found: 0815-0000"):
        open_device("cameras", "pylon", {"serial": "none such"})
    with VirtualPylonCamera(scene.expose, SENSOR) as camera:
        with pytest.raises(OutOfRange, match="call configure"):
            camera.trigger_and_grab(TIMEOUT)
    with pytest.raises(OutOfRange, match="at most 4096"):
        VirtualPylonCamera(scene.expose, (5000, 10))


FAILURES = {
    "latency": (),
    "stale_frame": (),
    "short_frame": (IncompleteFrame,),
    "dropped_frame": (Timeout,),
    "unplug": (Disconnected,),
}


@pytest.mark.parametrize("times", [2, pytest.param(100, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("fault", FAILURES)
def test_a_fault_never_gives_a_wrong_frame(fault, times, scene, faults):
    """As often as asked, after a random number of good frames: the right error, no wrong frame."""

    def opened():
        camera = VirtualPylonCamera(scene.expose, SENSOR, faults)
        camera.configure(SETTINGS)
        return camera, []

    def good():
        frame = camera.trigger_and_grab(TIMEOUT)
        assert np.array_equal(frame.pixels, scene.shown)
        numbers.append(frame.number)
        assert numbers == sorted(set(numbers))

    camera, numbers = opened()
    for _ in range(times):
        for _ in range(1 + scene.random.integers(2)):
            good()
        faults.inject(fault)
        if FAILURES[fault]:
            with pytest.raises(FAILURES[fault]):
                camera.trigger_and_grab(0.05 if fault == "dropped_frame" else TIMEOUT)
        else:
            good()
        assert not faults.waiting()
        if fault == "unplug":
            camera.close()
            camera, numbers = opened()
        good()
    assert faults.happened[fault] == times
    camera.close()
