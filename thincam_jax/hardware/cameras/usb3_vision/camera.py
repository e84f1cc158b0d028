"""A USB3 Vision camera, one frame for each trigger."""

from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any

import usb.core
import usb.util

from thincam_jax.hardware.base import (
    CameraSettings,
    Connected,
    Frame,
    HardwareError,
    Identity,
    Timeout,
)
from thincam_jax.hardware.cameras.features import FeatureCamera, read, trigger_by_software
from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.features import GenApiFeatures, fetch_xml
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm
from thincam_jax.hardware.cameras.usb3_vision.link import CameraMemory, UsbLink, cameras_there
from thincam_jax.hardware.cameras.usb3_vision.stream import PIXEL_FORMATS, FrameReader, unpack

# Frames without chunk data, at any trigger.
_PLAIN = {"ChunkModeActive": False, "AcquisitionFrameRateEnable": False, "ExposureMode": "Timed"}


class Usb3VisionCamera(FeatureCamera):
    """A USB3 Vision camera.

    A frame belongs to a trigger if its block id is new and it was exposed after the camera's clock
    was read, right before the trigger; older frames are discarded. After any failure the stream is
    restarted, so that a late frame is not taken for the next.
    """

    _formats = PIXEL_FORMATS.keys()

    @dataclass(frozen=True)
    class Options:
        """Options of the camera.

        - `serial`: serial number of the camera, if there are several.
        - `backend`: a `usb.backend.IBackend` other than libusb's.
        - `compare_clocks`: False for a camera whose frames and registers have different clocks.
        """

        serial: str = ""
        backend: Any = None
        compare_clocks: bool = True

    @classmethod
    def connected(cls, backend: Any = None) -> list[Connected]:
        found = []
        for device in cameras_there(backend=backend):
            try:
                options = {"serial": device.serial_number or ""}
                about = f"{device.manufacturer} {device.product}"
            except (ValueError, usb.core.USBError):  # pyusb without permission: "no langid"
                options, about = {}, "this user may not open it; `thincam capture` says how"
            finally:
                usb.util.dispose_resources(device)
            found.append(Connected("camera", "usb3_vision", options, about))
        return found

    @classmethod
    def open(cls, options: Options) -> "Usb3VisionCamera":
        """Claim the camera and configure software triggers.

        `NotFound`, `PermissionDenied` (with the udev rule), `Busy`, `ProtocolError`.
        """
        link = UsbLink(options.serial, options.backend)
        try:
            return cls(link, options.compare_clocks)
        except HardwareError:
            link.close()
            raise

    def __init__(self, link: UsbLink, compare_clocks: bool):
        self._link, control = link, CameraMemory(link)
        self._control = control
        registers = Abrm.MANUFACTURER, Abrm.MODEL, Abrm.SERIAL, Abrm.DEVICE_VERSION
        texts = (gencp.text(control.read(register, gencp.TEXT_LENGTH)) for register in registers)
        self.identity = Identity(*texts)
        self._name = link.name = str(self.identity)
        self._compare_clocks = compare_clocks and control.has_clock
        self._features = GenApiFeatures(link, control, fetch_xml(link, control))
        self._stream = FrameReader(link, control, control.sirm)
        self._last_block, self._frames_before = -1, 0
        self._in_step = False
        self._stop()
        for name, value in _PLAIN.items():
            if self._features.has(name):
                self._features.set(name, value)
        with self._translated("open"):
            trigger_by_software(self._features)
            exposure = read(self._features).exposure
        self.configure(CameraSettings(exposure, pixel_format="Mono8"))

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._in_step = False
        taken = super().configure(settings)
        assert taken.region is not None
        self._stream.prepare(taken.pixel_format, taken.region)
        self._start()
        return taken

    def flush(self) -> None:
        if not (self._in_step and self._stream.is_empty()):
            self._restart()

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings = self._require_settings()
        if self._external or not self._in_step:
            self._restart()
        self._in_step = False
        before = self._control.clock() if self._compare_clocks else 0
        if not self._external:
            self._features.execute("TriggerSoftware")
        deadline = monotonic() + settings.exposure + timeout
        discarded = 0
        while True:
            try:
                leader, data = self._stream.read(deadline)
            except Timeout as error:
                raise self._no_frame(timeout, f", {discarded} older ones discarded") from error
            if leader.block > self._last_block and leader.time >= before:
                break
            self._last_block = max(self._last_block, leader.block)
            discarded += 1
            if monotonic() > deadline:
                raise self._no_frame(timeout, f", {discarded} older ones discarded")
        self._last_block, self._in_step = leader.block, True
        shape = leader.region.height, leader.region.width
        return Frame(
            unpack(data, settings.pixel_format, shape),
            self._frames_before + leader.block,
            leader.time * 1e-9,
            settings.exposure,
            PIXEL_FORMATS[settings.pixel_format][1],
        )

    def _translated(self, operation: str) -> AbstractContextManager[None]:
        return self._features.evaluating(operation)

    def _stop(self) -> None:
        self._features.execute("AcquisitionStop")
        self._stream.stop()
        self._lock(0)

    def _lock(self, locked: int) -> None:
        if self._features.has("TLParamsLocked"):
            self._features.set("TLParamsLocked", locked)

    def _restart(self) -> None:
        self._stop()
        self._start()

    def _start(self) -> None:
        """Start the stream. The camera then counts from 0, while the frames' numbers continue."""
        self._frames_before += self._last_block + 1
        self._last_block = -1
        self._lock(1)
        self._stream.start()
        self._features.execute("AcquisitionStart")
        self._in_step = True

    def close(self) -> None:
        with suppress(HardwareError):
            self._stop()
        self._link.close()
