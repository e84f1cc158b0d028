"""`PylablibCamera` on a device of pylablib's own interface, and of a double where it is missing."""

import sys
import time
from collections import namedtuple
from importlib.util import find_spec
from types import ModuleType

import numpy as np
import pytest
from hardware.cameras import pylablib_double

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.base import (
    Disconnected,
    Identity,
    IncompleteFrame,
    NotFound,
    OutOfRange,
    Region,
    Timeout,
)
from thincam_jax.hardware.registry import driver_report, open_device

SENSOR = 24, 40
REGION = Region(4, 8, 12, 20)
SETTINGS = CameraSettings(0.004, REGION)
TIMEOUT = 1.0  # s
DeviceInfo = namedtuple("DeviceInfo", "model name serial_number firmware_version")
FrameInfo = namedtuple("FrameInfo", "frame_index framestamp")


class Dummy:
    """A camera that runs freely once started; each frame is of counts of its own."""

    _TFrameInfo = FrameInfo
    faults: list[str] = []  # to come
    stamps = True  # whether the camera numbers its frames itself

    def __init__(self, serial="7"):
        super().__init__()
        self.serial, self.roi, self.exposure, self.mode = serial, (0, 40, 0, 24, 1, 1), 0.01, "int"
        self.started, self.here, self.stamp, self.random = None, True, 0, np.random.default_rng(3)
        self.shown, self.dropped, self.last = np.zeros(0), False, None
        self._add_settings_variable("trigger_mode", lambda: self.mode, self.set_trigger_mode)

    def due(self, fault):
        if there := fault in self.faults:
            self.faults.remove(fault)
        return there

    def set_trigger_mode(self, mode):
        self.mode = mode

    def is_opened(self):
        return self.here

    def close(self):
        self.here = False

    def get_device_info(self):
        return DeviceInfo("CS165", "dummy", self.serial, "1.2")

    def get_detector_size(self):
        return SENSOR[1], SENSOR[0]

    def get_roi(self):
        return self.roi

    def set_roi(self, hstart=0, hend=None, vstart=0, vend=None, hbin=1, vbin=1):
        bins = min(hbin, 4), min(vbin, 4)
        self.roi = hstart - hstart % 2, hend, vstart, vend, *bins

    def get_frame_timings(self):
        if not self.here:
            raise self.Error("invalid handle")
        return self.exposure, self.exposure

    def get_exposure(self):
        return self.get_frame_timings()[0]

    def set_exposure(self, exposure):
        self.exposure = min(max(round(exposure, 5), 1e-5), 10.0)

    def setup_acquisition(self, nframes=10):
        super().setup_acquisition(nframes=nframes)

    def start_acquisition(self, *args, **kwargs):
        self.stop_acquisition()
        super().start_acquisition(*args, **kwargs)
        self._frame_counter.reset(self._acq_params["nframes"])
        if self.due("unplug"):
            self.here = False
            raise self.Error("device is not there")
        self.started, self.dropped = time.monotonic(), self.due("dropped_frame")
        self.early = self.due("early_frame")
        if self.due("latency"):
            self.started += 0.03

    def stop_acquisition(self):
        self.started = None

    def acquisition_in_progress(self):
        return self.started is not None

    def _get_data_dimensions_rc(self):
        left, right, top, bottom, across, down = self.roi
        return (bottom - top) // down, (right - left) // across

    def _get_acquired_frames(self):
        if self.started is None or self.dropped or self.mode == "ext":
            return 0
        return 1 if self.early else max(int((time.monotonic() - self.started) / self.exposure), 0)

    def _read_frames(self, rng, return_info=False):
        if self.due("transfer"):
            raise self.FrameTransferError("overrun")
        if self.last and self.due("stale_frame"):
            return [self.last[0]], [FrameInfo(0, self.last[1])], 0
        self.stamp += 1
        shape = self._get_data_dimensions_rc()
        self.shown = self.random.integers(0, 4096, shape).astype(np.uint16)
        self.last = self.shown, self.stamp if self.stamps else None
        frame = self.shown[: shape[0] // 2] if self.due("short_frame") else self.shown
        return [frame], [FrameInfo(0, self.last[1])], 0


class Double(pylablib_double.Camera):
    def _read_frames(self, rng, return_info=False):
        raise NotImplementedError

    def read_multiple_images(self, *args, **kwargs):
        found = super().read_multiple_images(*args, **kwargs)
        return found[:2]


@pytest.fixture(params=["pylablib", "double"])
def kind(request, monkeypatch):
    """A class in a module `pylablib.devices.Dummy`."""
    if request.param == "double":
        bases = (Double,)
        monkeypatch.setitem(sys.modules, "pylablib", ModuleType("pylablib"))
    elif find_spec("pylablib") is None:
        pytest.skip("needs pylablib; the double stands in for it")
    else:
        from pylablib.devices.interface import camera  # pyright: ignore[reportMissingImports]

        bases = (camera.IBinROICamera, camera.IExposureCamera)
    module = ModuleType("pylablib.devices.Dummy")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    module.DummyCamera = type("DummyCamera", (Dummy, *bases), {"faults": []})
    return module.DummyCamera


def opened(**options):
    return open_device("cameras", "pylablib", {"camera": "Dummy.DummyCamera", **options})


@pytest.fixture
def camera(kind):
    with opened() as camera:
        camera.configure(SETTINGS)
        yield camera


def test_frames_and_settings(kind):
    with opened(arguments={"serial": "12"}) as camera:
        assert camera.identity == Identity("Dummy", "CS165", "12", "1.2")
        assert camera.sensor_shape == SENSOR
        with pytest.raises(OutOfRange, match="no settings"):
            camera.trigger_and_grab(TIMEOUT)
        taken = camera.configure(CameraSettings(0.0012345678))
        assert taken == CameraSettings(0.00123, Region(0, 0, *SENSOR))
        for number in (1, 2):
            frame = camera.trigger_and_grab(TIMEOUT)
            assert np.array_equal(frame.pixels, camera._camera.shown)
            assert (frame.number, frame.exposure, frame.bit_depth) == (number, 0.00123, 12)
        assert camera.configure(CameraSettings(0.002, Region(5, 9, 10, 12))).region == Region(
            5, 8, 10, 13
        )
        binned = camera.configure(CameraSettings(0.002, Region(2, 4, 5, 8), "Mono16", binning=2))
        assert (binned.region, binned.binning) == (Region(2, 4, 5, 8), 2)
        assert camera._camera.roi == (8, 24, 4, 14, 2, 2)
        frame = camera.trigger_and_grab(TIMEOUT)
        assert (frame.number, frame.pixels.shape, frame.bit_depth) == (3, (5, 8), 16)
    assert not camera._camera.here


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (CameraSettings(100.0), "an exposure of 100 s; give 10 s"),
        (CameraSettings(0.01, Region(0, 0, 25, 40)), "outside of the sensor; give 24 × 40"),
        (CameraSettings(0.01, binning=5), "binning of 5; give 4"),
        (CameraSettings(0.01, pixel_format="BayerRG8"), "give one of Mono8, Mono10"),
        (CameraSettings(0.01, gain=3.0), "give it in the option settings"),
        (CameraSettings(0.01, trigger="Line0"), "give it in the option settings"),
    ],
)
def test_what_it_cannot_take_is_refused(camera, settings, said):
    with pytest.raises(OutOfRange, match=said):
        camera.configure(settings)
    camera.configure(SETTINGS)
    assert camera.trigger_and_grab(TIMEOUT).pixels.shape == (12, 20)


FAILURES = {
    "latency": None,
    "early_frame": IncompleteFrame,
    "stale_frame": IncompleteFrame,
    "short_frame": IncompleteFrame,
    "transfer": IncompleteFrame,
    "dropped_frame": Timeout,
    "unplug": Disconnected,
}


@pytest.mark.parametrize("fault", FAILURES)
def test_a_fault_never_gives_a_wrong_frame(fault, kind):
    def good():
        frame = camera.trigger_and_grab(TIMEOUT)
        assert np.array_equal(frame.pixels, camera._camera.shown)
        numbers.append(frame.number)
        assert numbers == sorted(set(numbers))

    camera, numbers = opened(), []
    camera.configure(SETTINGS)
    for _ in range(2):
        for _ in range(2):
            good()
        kind.faults.append(fault)
        if error := FAILURES[fault]:
            with pytest.raises(error):
                camera.trigger_and_grab(0.05)
        if fault == "unplug":
            camera.close()
            camera, numbers = opened(), []
            camera.configure(SETTINGS)
        good()
        assert not kind.faults
    camera.close()


def test_frames_without_numbers_of_their_own(kind, camera):
    kind.stamps = False
    assert [camera.trigger_and_grab(TIMEOUT).number for _ in range(3)] == [1, 2, 3]


def test_an_external_trigger_is_a_setting(kind):
    with opened(settings={"trigger_mode": "ext"}) as camera:
        camera.configure(SETTINGS)
        with pytest.raises(Timeout, match="no frame came; .* connect its trigger"):
            camera.trigger_and_grab(0.02)
        camera._camera.mode = "int"  # pulses come
        assert camera.trigger_and_grab(TIMEOUT).number == 1
    with pytest.raises(OutOfRange, match="no setting trigger_mod; give another name"):
        opened(settings={"trigger_mod": "ext"})


@pytest.mark.parametrize("name", ["", "Nowhere.Camera", "Dummy.Nothing", "Dummy.NoCamera"])
def test_a_class_that_is_no_camera(kind, name):
    sys.modules["pylablib.devices.Dummy"].NoCamera = object  # pyright: ignore
    with pytest.raises(NotFound, match=f"no camera '{name}'.*; give camera, such as"):
        opened(camera=name)


def test_one_that_cannot_be_opened(kind, monkeypatch):
    def fails(self, serial="7"):
        raise OSError("missing uc480_64.dll")

    monkeypatch.setattr(kind, "__init__", fails)
    with pytest.raises(NotFound, match="uc480_64.dll; connect it, install its maker's software"):
        opened()


def test_without_pylablib_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylablib", None)
    with pytest.raises(NotFound, match=r"pip install 'thincam-jax\[pylablib\]'"):
        open_device("cameras", "pylablib", {"camera": "Thorlabs.ThorlabsTLCamera"})
    (line,) = (one for one in driver_report() if "cameras pylablib" in one)
    assert "its library is missing" in line and "thincam-jax[pylablib]" in line
