"""`RaspberryPiCamera` on a double of picamera2's interface."""

import sys
from types import ModuleType

import numpy as np
import pytest
from hardware.cameras import picamera2_double
from hardware.cameras.picamera2_double import SENSOR

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.base import Busy, Disconnected, NotFound, OutOfRange, Region, Timeout
from thincam_jax.hardware.plans import pictures
from thincam_jax.hardware.registry import driver, open_device
from thincam_jax.hardware.virtual.devices import VirtualDisplay

SETTINGS = CameraSettings(0.004, None, "BayerRG10")


class Seen:
    """Counts of 12 bit: a texture that changes with each frame, and with the level shown."""

    level = 0

    def __call__(self, number):
        random = np.random.default_rng(number)
        return random.integers(64, 3900, SENSOR).astype(np.uint16) // 2 + self.level


@pytest.fixture
def module(monkeypatch):
    """The module, with a class of its own."""
    kind = type("Picamera2", (picamera2_double.Picamera2,), {"seen": Seen(), "opened": []})
    kind.faults = set()
    found = ModuleType("picamera2")
    found.Picamera2 = kind
    monkeypatch.setitem(sys.modules, "picamera2", found)
    return found


@pytest.fixture
def camera(module):
    with open_device("cameras", "picamera2", {}) as opened:
        yield opened
    assert not module.Picamera2.opened[-1].running and module.Picamera2.opened[-1].held == 0


def counts_of(module, name, bits):
    """Counts of the newest frame, as they were before they were packed."""
    return module.Picamera2.seen(module.Picamera2.opened[-1].count) >> (12 - bits)


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("model_5", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_counts_of_every_format(module, packed, model_5, bits):
    module.Picamera2.model_5 = model_5 and bits > 8
    region = Region(3, 2, 5, 8)
    with open_device("cameras", "picamera2", {"packed": packed}) as camera:
        settings = CameraSettings(0.004, region, f"BayerRG{bits}")
        if packed and model_5 and bits > 8:
            with pytest.raises(OutOfRange, match="RGGB_PISP_COMP1; give its option packed: false"):
                camera.configure(settings)
            return
        taken = camera.configure(settings)
        frame = camera.trigger_and_grab(1.0)
    assert taken.region == region and frame.bit_depth == bits
    assert taken.bayer == "GBRG"  # rows from an odd one
    whole = counts_of(module, taken.pixel_format, bits)
    np.testing.assert_array_equal(frame.pixels, whole[3:8, 2:10])
    assert frame.pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert taken.black_level == 4096 / 2 ** (16 - bits)


def test_a_grey_sensor(module):
    module.Picamera2.order = "R"
    with open_device("cameras", "picamera2") as camera:
        taken = camera.configure(CameraSettings(0.002, None, "Mono10"))
        assert taken.bayer is None and camera.trigger_and_grab(1.0).pixels.shape == SENSOR


def test_it_says_who_it_is(module, camera):
    assert str(camera.identity) == "Raspberry Pi imx219 (/base/imx219@10)"
    assert camera.sensor_shape == SENSOR
    (found,) = driver("cameras", "picamera2").connected()
    assert str(found) == "camera picamera2 {camera: 0}: imx219"


@pytest.mark.parametrize("exposure", [0.001, 0.0123456, 0.02])
@pytest.mark.parametrize("gain", [0.0, 6.0])
def test_settings_are_those_of_the_frames(camera, exposure, gain):
    """Whole lines; the settings that it took are taken again as they are, as a resumed run asks."""
    taken = camera.configure(CameraSettings(exposure, None, "BayerRG10", gain))
    assert taken.exposure == pytest.approx(exposure, abs=20e-6)
    assert taken.gain == pytest.approx(gain, abs=0.3)
    assert camera.trigger_and_grab(1.0).exposure == taken.exposure
    again = camera.configure(taken)
    assert again.exposure == taken.exposure
    assert again.gain == pytest.approx(taken.gain, abs=1e-9)


def test_nothing_is_automatic(module, camera):
    camera.configure(SETTINGS)
    asked = module.Picamera2.opened[-1].asked
    assert all(one["ColourGains"] == (1.0, 1.0) and not one["AeEnable"] for one in asked)


def test_frames_from_before_the_trigger_are_dropped(module, camera):
    """One waits in the queue, and one is exposed as it is triggered."""
    camera.configure(SETTINGS)
    module.Picamera2.faults = {"queued"}
    numbers = [camera.trigger_and_grab(1.0) for _ in range(4)]
    device = module.Picamera2.opened[-1]
    assert np.all(np.diff([one.number for one in numbers]) > 0)
    before = device.count
    frame = camera.trigger_and_grab(1.0)
    last = device.seen(device.count - 1) >> 2  # the newest one waits again
    assert device.count > before + 1
    np.testing.assert_array_equal(frame.pixels, last)


def test_old_frames_after_a_change_are_dropped(module, camera):
    camera.configure(SETTINGS)
    camera.trigger_and_grab(1.0)
    taken = camera.configure(CameraSettings(0.009, None, "BayerRG10", 6.0))
    assert taken.exposure == pytest.approx(0.009, abs=20e-6)
    device = module.Picamera2.opened[-1]
    device.at = (4000, 1.0)  # frames of before are still in the pipeline
    device.set_controls({**device.asked[-1]})
    assert camera.trigger_and_grab(1.0).exposure == taken.exposure
    module.Picamera2.faults = {"old"}
    taken = camera.configure(SETTINGS)
    assert taken.exposure == pytest.approx(0.004, abs=20e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (CameraSettings(20.0, None, "BayerRG10"), "exposure of 2e.07 µs; give 75 to 1.17668e"),
        (CameraSettings(0.01, None, "BayerRG10", 30.0), "a gain of 31.6.* give 1 to 10.7 times"),
        (CameraSettings(0.01, None, "BayerRG16"), "no format BayerRG16; give BayerRG10"),
        (CameraSettings(0.01, None, "BayerBG10"), "SBGGR10 of 10 × 13 pixels; give SRGGB10 of"),
        (CameraSettings(0.01, Region(8, 0, 3, 4), "BayerRG10"), "outside of the sensor"),
        (CameraSettings(0.01, None, "BayerRG10", black_level=3.0), "black level of 3; give 64"),
        (CameraSettings(0.01, None, "BayerRG10", binning=2), "a binning or a trigger; give none"),
    ],
)
def test_what_it_lacks_is_refused(camera, settings, message):
    with pytest.raises(OutOfRange, match=message):
        camera.configure(settings)


def test_settings_that_never_come_are_refused(module, camera):
    module.Picamera2.faults = {"stuck"}
    with pytest.raises(OutOfRange, match=r"exposes for 0.02 s at a gain of 1, not for 0.004 s"):
        camera.configure(SETTINGS)


def test_errors_are_those_of_a_device(module, camera):
    camera.configure(SETTINGS)
    device = module.Picamera2.opened[-1]
    for fault, error in (("unplug", Disconnected), ("nothing", Timeout)):
        module.Picamera2.faults = {fault}
        with pytest.raises(error) as told:
            camera.trigger_and_grab(0.2)
        assert "\n" not in str(told.value)
    assert device.cancelled == 1
    module.Picamera2.faults = set()
    assert camera.trigger_and_grab(1.0).pixels.shape == SENSOR
    module.Picamera2.busy = True
    with pytest.raises(Busy, match="resource busy; end the program"):
        open_device("cameras", "picamera2", {})
    module.Picamera2.busy = False
    with pytest.raises(NotFound, match="rpicam-hello --list-cameras"):
        open_device("cameras", "picamera2", {"camera": 3})


def test_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(NotFound, match="sudo apt install python3-picamera2"):
        driver("cameras", "picamera2")


def test_an_acquisition_is_resumed(module, tmp_path):
    """With two exposures; each frame has the settings of its step."""
    levels = {"a": np.full((2, 3), 9, np.uint8), "b": np.full((2, 3), 200, np.uint8)}

    def show(shown):
        module.Picamera2.seen.level = int(shown.max())

    def begin(progress=None):
        with Rig(
            lambda: open_device("cameras", "picamera2", {"packed": True}),
            lambda: VirtualDisplay((2, 3), show),
            lambda pattern: levels.get(pattern.label, np.zeros((2, 3), np.uint8)),
        ) as rig:
            return acquire(
                pictures(levels, SETTINGS, frames=2), rig, tmp_path / "store",
                procedure=Procedure(timeout=1.0), progress=progress
            )  # fmt: skip

    with pytest.raises(ZeroDivisionError):
        begin(lambda now: 1 / (now.done - 2))
    assert begin().complete
    taken = Acquisition.load(tmp_path / "store")
    assert len(taken.shots) == 4 and taken.bits == 10
    assert len({shot["number"] for shot in taken.shots}) == 4
