"""A USB3 Vision camera, triggered by software, one frame at a time."""

from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any

from thincam_jax.hardware.base import Camera, CameraSettings, Frame, Identity, Region
from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.features import Features, fetch_xml
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm
from thincam_jax.hardware.cameras.usb3_vision.link import Control, UsbLink
from thincam_jax.hardware.cameras.usb3_vision.stream import PIXEL_FORMATS, Stream, unpack
from thincam_jax.hardware.errors import HardwareError, OutOfRange, Timeout


class Usb3VisionCamera(Camera):
    """A camera that speaks USB3 Vision.

    A frame answers a trigger if its block id is new and it was exposed after the camera's clock
    was read, right before the trigger; older frames are discarded. After any failure the stream is
    stopped and begun anew, so that a frame that comes late is not taken for the next one.
    """

    @dataclass(frozen=True)
    class Options:
        """`serial`: which camera, if there are several; `backend`: a `usb.backend.IBackend` other
        than libusb's; `compare_clocks`: False for a camera whose frames carry another clock than
        its registers."""

        serial: str = ""
        backend: Any = None
        compare_clocks: bool = True

    @classmethod
    def open(cls, options: Options) -> "Usb3VisionCamera":
        """Claims the camera and sets it to wait for software triggers.

        `NotFound`, `PermissionDenied` (its remedy is the udev rule), `Busy`, `ProtocolError`.
        """
        link = UsbLink(options.serial, options.backend)
        try:
            return cls(link, options.compare_clocks)
        except HardwareError:
            link.close()
            raise

    def __init__(self, link: UsbLink, compare_clocks: bool):
        self._link, control = link, Control(link)
        self._control = control
        self._identity = Identity(
            *(
                gencp.text(control.read(register, gencp.TEXT_LENGTH))
                for register in (Abrm.MANUFACTURER, Abrm.MODEL, Abrm.SERIAL, Abrm.DEVICE_VERSION)
            )
        )
        link.name = str(self._identity)
        self._compare_clocks = compare_clocks and control.has_clock
        self._features = Features(link, control, fetch_xml(link, control))
        self._stream = Stream(link, control, control.sirm)
        self._last_block, self._frames_before = -1, 0
        self._in_step = False
        self._stop()
        for name, value in (
            ("ChunkModeActive", False),
            ("AcquisitionMode", "Continuous"),
            ("TriggerSelector", "FrameStart"),
            ("TriggerMode", "Off"),  # some take another source only then
            ("TriggerSource", "Software"),
            ("TriggerMode", "On"),
            ("AcquisitionFrameRateEnable", False),
            ("ExposureMode", "Timed"),
            ("ExposureAuto", "Off"),
            ("GainAuto", "Off"),
        ):
            self._features.write_if_there(name, value)
        self._settings = self.configure(
            CameraSettings(self._features.number("ExposureTime") * 1e-6, pixel_format="Mono8")
        )

    @property
    def identity(self) -> Identity:
        return self._identity

    @property
    def sensor_shape(self) -> tuple[int, int]:
        names = ("SensorHeight", "SensorWidth")
        if not self._features.has(names[0]):
            names = ("HeightMax", "WidthMax")
        return self._features.integer(names[0]), self._features.integer(names[1])

    def configure(self, settings: CameraSettings) -> CameraSettings:
        features, (rows, columns) = self._features, self.sensor_shape
        region = settings.region or Region(0, 0, rows, columns)
        if (
            min(region.top, region.left) < 0 or min(region.height, region.width) < 1
            or region.top + region.height > rows or region.left + region.width > columns
        ):  # fmt: skip
            raise OutOfRange(self._link.name, "configure", f"{region} lies outside of the sensor",
                             f"it has {rows} rows and {columns} columns")  # fmt: skip
        offered = [name for name in features.choices("PixelFormat") if name in PIXEL_FORMATS]
        if settings.pixel_format not in offered:
            raise OutOfRange(self._link.name, "configure", f"it has no {settings.pixel_format}",
                             f"use one of {', '.join(offered)}")  # fmt: skip
        self._in_step = False
        self._stop()
        features.write("PixelFormat", settings.pixel_format)
        for name in ("OffsetX", "OffsetY"):  # leave room for the size that comes next
            features.write_nearest(name, 0)
        features.write_nearest("Width", region.width, "pixels")
        features.write_nearest("Height", region.height, "pixels")
        features.write_nearest("OffsetX", region.left, "pixels")
        features.write_nearest("OffsetY", region.top, "pixels")
        features.write_nearest("ExposureTime", settings.exposure * 1e6, "µs")
        features.write_nearest("Gain", settings.gain, "dB")
        taken = Region(*(features.integer(n) for n in ("OffsetY", "OffsetX", "Height", "Width")))
        self._settings = CameraSettings(
            features.number("ExposureTime") * 1e-6,
            taken,
            features.choice("PixelFormat"),
            features.number("Gain"),
        )
        self._stream.prepare(self._settings.pixel_format, taken)
        self._start()
        return self._settings

    def flush(self) -> None:
        if not (self._in_step and self._stream.is_empty()):
            self._restart()

    def trigger_and_grab(self, timeout: float) -> Frame:
        if not self._in_step:
            self._restart()
        self._in_step = False
        before = self._control.clock() if self._compare_clocks else 0
        self._features.execute("TriggerSoftware")
        deadline = monotonic() + self._settings.exposure + timeout
        discarded = 0
        while True:
            try:
                leader, data = self._stream.read(deadline)
            except Timeout as error:
                raise self._no_frame(timeout, discarded) from error
            if leader.block > self._last_block and leader.time >= before:
                break
            self._last_block = max(self._last_block, leader.block)
            discarded += 1
            if monotonic() > deadline:
                raise self._no_frame(timeout, discarded)
        self._last_block, self._in_step = leader.block, True
        _, bit_depth = PIXEL_FORMATS[self._settings.pixel_format]
        return Frame(
            unpack(data, self._settings.pixel_format, (leader.region.height, leader.region.width)),
            self._frames_before + leader.block,
            leader.time * 1e-9,
            self._settings.exposure,
            bit_depth,
        )

    def _no_frame(self, timeout: float, discarded: int) -> Timeout:
        cause = f"no frame within {timeout:g} s of the end of the exposure"
        return Timeout(self._link.name, "trigger", f"{cause}, {discarded} older ones discarded",
                       "trigger again, or allow more time")  # fmt: skip

    def _stop(self) -> None:
        self._features.execute("AcquisitionStop")
        self._stream.stop()
        self._features.write_if_there("TLParamsLocked", 0)

    def _restart(self) -> None:
        self._stop()
        self._start()

    def _start(self) -> None:
        """Begins the stream anew. The camera then counts from 0; the frames' numbers go on."""
        self._frames_before += self._last_block + 1
        self._last_block = -1
        self._features.write_if_there("TLParamsLocked", 1)
        self._stream.start()
        self._features.execute("AcquisitionStart")
        self._in_step = True

    def close(self) -> None:
        with suppress(HardwareError):
            self._stop()
        self._link.close()
