"""The camera against the virtual device: settings, frames, and who may open it."""

import errno
import sys
import time

import numpy as np
import pytest
import usb.core

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.base import (
    Busy,
    NotFound,
    OutOfRange,
    PermissionDenied,
    ProtocolError,
    Region,
    Timeout,
)
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.cameras.usb3_vision.stream import PIXEL_FORMATS
from thincam_jax.hardware.registry import open_device
from thincam_jax.hardware.virtual.rig import bits_of
from thincam_jax.hardware.virtual.usb3_vision import TRIGGER_MODE

REGION = Region(8, 4, 20, 28)


def open_camera(device, **options):
    return Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device, **options))


FORMATS = "Mono8", "Mono10", "Mono12", "Mono16", "Mono12p", "BayerRG8", "BayerRG12", "BayerRG12p"


@pytest.mark.parametrize("pixel_format", FORMATS)
@pytest.mark.parametrize("region", [None, REGION, Region(0, 0, 16, 20)])
def test_frames_arrive_exactly(camera, scene, pixel_format, region):
    taken = camera.configure(CameraSettings(0.002, region, pixel_format, gain=6.0))
    assert taken.region == (region or Region(0, 0, 48, 64))
    assert (taken.exposure, taken.gain, taken.pixel_format) == (0.002, 6.0, pixel_format)
    for number in range(2):
        frame = camera.trigger_and_grab(1.0)
        assert np.array_equal(frame.pixels, scene.frame(number, taken))
        assert (frame.number, frame.exposure) == (number, 0.002)
        assert frame.bit_depth == bits_of(taken)
    assert frame.pixels.dtype == (np.uint8 if frame.bit_depth == 8 else np.uint16)


def test_codes_of_pixel_formats_are_those_of_the_vendors():
    """Those of PFNC, as Basler's library has them."""
    from thincam_jax.hardware.cameras.pylon import pylon

    assert len(PIXEL_FORMATS) == 25
    for name, (code, bits) in PIXEL_FORMATS.items():
        assert code == getattr(pylon, f"PixelType_{name}"), name
        assert bits == pylon.BitDepth(code), name


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (CameraSettings(1e-6), "ExposureTime of 1e-06 s; give 1e-05 … 10 s"),
        (CameraSettings(0.01, gain=30.0), "Gain of 30 dB; give 0 … 24 dB"),
        (CameraSettings(0.01, Region(0, 0, 49, 64)), "a part of 48 × 64"),
        (CameraSettings(0.01, Region(0, 0, 4, 64)), "Height of 4 pixels; give at least 16"),
        (
            CameraSettings(0.01, pixel_format="BayerGB10"),
            "no pixel format BayerGB10; give one of Mono8, Mono10",
        ),
        (CameraSettings(0.01, binning=2), "BinningHorizontal of 2; give 1 … 1"),
        (CameraSettings(0.01, black_level=60.0), "BlackLevel of 60; give 0 … 0"),
        (CameraSettings(0.01, trigger="Line7"), "no trigger source Line7; give one of Software, L"),
    ],
)
def test_what_it_cannot_take_is_refused(camera, settings, said):
    with pytest.raises(OutOfRange, match=said):
        camera.configure(settings)
    camera.configure(CameraSettings(0.01))
    camera.trigger_and_grab(1.0)


@pytest.mark.parametrize("flush", [True, False])
def test_a_frame_that_nobody_asked_for_is_discarded(device, camera, scene, flush):
    camera.configure(CameraSettings(0.01))
    device._expose_frame()  # as if another trigger line had fired
    if flush:
        camera.flush()
    frame = camera.trigger_and_grab(1.0)
    assert np.array_equal(frame.pixels, scene.frame(1, device.settings))


def test_frames_at_a_line_are_awaited(device, camera, scene):
    settings = CameraSettings(0.002, trigger="Line0")
    assert camera.configure(settings).trigger == "Line0"
    started = time.monotonic()
    frames = [camera.trigger_and_grab(1.0) for _ in range(3)]
    assert time.monotonic() - started > 3 * 0.02
    assert [frame.number for frame in frames] == [0, 1, 2]
    device._expose_frame()  # a pulse before the call does not count
    exposed = scene.exposures
    assert scene.number_in(camera.trigger_and_grab(1.0).pixels) == exposed
    camera.configure(CameraSettings(0.002))
    exposed = scene.exposures
    assert scene.number_in(camera.trigger_and_grab(1.0).pixels) == exposed


def test_a_line_without_pulses_is_named(device, camera, scene):
    camera.configure(CameraSettings(0.01, trigger="Line1"))
    with pytest.raises(Timeout, match=r"no frame within 0.11 s.*; is the .* connected to Line1\?$"):
        camera.trigger_and_grab(0.1)
    camera._features.execute("TriggerSoftware")  # is ignored
    assert scene.exposures == 0


def test_a_camera_that_is_not_there(device):
    with pytest.raises(NotFound, match="connected are 0001"):
        open_camera(device, serial="B8")
    device.enumerate_devices = lambda: iter(())
    with pytest.raises(NotFound, match="no USB3 Vision camera is connected"):
        open_camera(device)


def test_without_permission_the_remedy_is_a_udev_rule(device):
    def refuse(dev):
        raise usb.core.USBError("Access denied", errno=errno.EACCES)

    device.open_device = refuse
    with pytest.raises(PermissionDenied, match='ATTR{idVendor}=="cafe".*/etc/udev/rules.d'):
        open_camera(device)


def test_one_that_is_open_is_busy(device, camera):
    with pytest.raises(Busy, match="another program has it open"):
        open_camera(device)
    camera.close()
    open_camera(device).close()


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "thincam_jax.hardware.cameras.usb3_vision", raising=False)
    monkeypatch.delitem(sys.modules, "thincam_jax.hardware.cameras.usb3_vision.camera", False)
    monkeypatch.delitem(sys.modules, "thincam_jax.hardware.cameras.usb3_vision.link", False)
    monkeypatch.setitem(sys.modules, "usb", None)
    with pytest.raises(NotFound, match=r"pip install 'thincam-jax\[hardware\]'"):
        open_device("cameras", "usb3_vision")


def test_a_halted_endpoint_is_used_again(device, camera):
    cleared = []

    def halted(dev_handle, ep, intf, buff, timeout):
        device.bulk_read = type(device).bulk_read.__get__(device)
        device.clear_halt = lambda dev_handle, ep: cleared.append(ep)
        raise usb.core.USBError("Pipe error", errno=errno.EPIPE)

    device.bulk_read = halted
    with pytest.raises(ProtocolError):
        camera.trigger_and_grab(1.0)
    assert cleared[0] == 0x81
    camera._control.read_number(0)  # the answer to what was asked before is passed over
    assert camera.trigger_and_grab(1.0).pixels.shape == (48, 64)


def test_a_frame_that_comes_too_late_is_not_taken_for_the_next(device, camera, scene):
    camera.configure(CameraSettings(0.001))
    device.faults.inject("latency")
    with pytest.raises(Timeout):
        camera.trigger_and_grab(0.001)
    frame = camera.trigger_and_grab(1.0)
    assert (scene.number_in(frame.pixels), frame.number) == (1, 0)


def test_endless_stale_frames_end_in_a_timeout(device, camera):
    """A camera that runs freely with a clock that stands still."""
    camera.configure(CameraSettings(0.01))
    camera._features.set("TriggerMode", "Off")
    camera._control.clock = lambda: 2**63
    with pytest.raises(Timeout, match=r"[1-9]\d* older ones discarded"):
        camera.trigger_and_grab(0.01)
    assert device._number(TRIGGER_MODE) == 0


def test_another_size_than_was_agreed_is_an_error(device, camera):
    camera.configure(CameraSettings(0.01))
    device._acquiring = False
    camera._control.write_number(0x2008, 32)  # the width, behind the camera's back
    device._acquiring = True
    with pytest.raises(ProtocolError, match="agreed were"):
        camera.trigger_and_grab(1.0)
