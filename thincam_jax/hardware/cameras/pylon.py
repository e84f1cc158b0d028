"""Basler's cameras, and Basler's emulator, by pypylon."""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from thincam_jax.hardware import base
from thincam_jax.hardware.base import CameraSettings, Connected, Frame, HardwareError, Identity
from thincam_jax.hardware.cameras.features import (
    BIT_DEPTHS,
    FeatureCamera,
    FrameCount,
    Number,
    Value,
    text,
    trigger_by_software,
)

with warnings.catch_warnings():
    # Raised as an error, SWIG's warning about its own types crashes the interpreter.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pypylon import genicam, pylon


class PylonCamera(FeatureCamera):
    """A camera supported by pylon: USB3 Vision or GigE Vision, or its emulator (PYLON_CAMEMU=1).

    The software trigger of a frame is sent once the camera is ready: pylon silently loses earlier
    ones. After a failed frame the stream is restarted, so that a late one is not taken for the
    next.
    """

    @dataclass(frozen=True)
    class Options:
        """`serial`: number of the camera, or "" for the first one found."""

        serial: str = ""

    def __init__(self, camera: Any):
        self._camera, self._name = camera, "pylon camera"
        self._count = FrameCount()
        try:
            with self._translated("open"):
                camera.Open()
                self._introduce()
        except BaseException:
            self.close()
            raise

    def _introduce(self) -> None:
        self._features = features = _Features(self._camera.GetNodeMap())
        info = self._camera.GetDeviceInfo()
        maker, version = info.GetVendorName(), text(features, "DeviceFirmwareVersion")
        self.identity = Identity(maker, info.GetModelName(), info.GetSerialNumber(), version)
        self._name = str(self.identity)
        ticks = "GevTimestampTickFrequency"  # of GigE Vision; USB3 Vision counts nanoseconds
        self._tick = 1 / float(features.get(ticks)) if features.has(ticks) else 1e-9
        trigger_by_software(features)

    @classmethod
    def connected(cls) -> list[Connected]:
        return [
            Connected(
                "camera",
                "pylon",
                {"serial": info.GetSerialNumber()},
                f"{info.GetVendorName()} {info.GetModelName()}",
            )
            for info in pylon.TlFactory.GetInstance().EnumerateDevices()
        ]

    @classmethod
    def open(cls, options: Options) -> "PylonCamera":
        """Open a camera; NotFound, Busy or PermissionDenied where that fails."""
        wanted, factory = pylon.DeviceInfo(), pylon.TlFactory.GetInstance()
        if options.serial:
            wanted.SetSerialNumber(options.serial)
        try:
            camera = pylon.InstantCamera(factory.CreateFirstDevice(wanted))
        except genicam.GenericException as error:
            found = [info.GetSerialNumber() for info in factory.EnumerateDevices()]
            cause = f"no camera {options.serial}".rstrip()
            remedy = f"connect one and switch it on; found: {', '.join(found) or 'none'}"
            raise base.NotFound("pylon", "open", cause, remedy) from error
        return cls(camera)

    def flush(self) -> None:
        with self._translated("flush"):
            while self._camera.IsGrabbing():
                result = self._camera.RetrieveResult(0, pylon.TimeoutHandling_Return)
                if not result.IsValid():
                    return
                result.Release()

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings = self._require_settings()
        milliseconds = int(1e3 * (settings.exposure + timeout)) + 1
        try:
            with self._translated("grab"):
                if self._external:
                    self._stop()  # with frames that are exposed already
                if not self._camera.IsGrabbing():
                    self._camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
                    self._count.restart()
                self.flush()
                if not self._external:
                    self._camera.WaitForFrameTriggerReady(
                        milliseconds, pylon.TimeoutHandling_ThrowException
                    )
                    self._trigger()
                result = self._camera.RetrieveResult(milliseconds, pylon.TimeoutHandling_Return)
                try:
                    if not result.IsValid():
                        raise self._no_frame(timeout)
                    return self._frame(result, settings)
                finally:
                    result.Release()
        except BaseException:
            self._stop()
            raise

    def close(self) -> None:
        self._stop()
        with suppress(genicam.GenericException):
            self._camera.Close()
            self._camera.DestroyDevice()

    def _trigger(self) -> None:
        self._camera.ExecuteSoftwareTrigger()

    def _frame(self, result: Any, settings: CameraSettings) -> Frame:
        if not result.GrabSucceeded():
            cause = result.ErrorDescription or f"pylon's error {result.ErrorCode:#x}"
            raise base.IncompleteFrame(self._name, "grab", cause, "take it again; check the cable")
        pixels, region = result.Array, settings.region
        if region is None or pixels.shape != (region.height, region.width):
            cause = f"{pixels.shape} pixels, and {region} is set"
            raise base.ProtocolError(self._name, "grab", cause, "configure the camera again")
        # The emulator has no clock.
        moment = result.TimeStamp * self._tick if result.TimeStamp else time.monotonic()
        bits = BIT_DEPTHS[settings.pixel_format]
        return Frame(pixels, self._count.number(result.BlockID), moment, settings.exposure, bits)

    def _stop(self) -> None:
        with suppress(genicam.GenericException):
            self._camera.StopGrabbing()

    @contextmanager
    def _translated(self, operation: str) -> Iterator[None]:
        """Turn errors of pylon into those of a device.

        Much succeeds with a disconnected camera, so that is checked at the end.
        """
        failure = None
        try:
            yield
        except (genicam.GenericException, HardwareError) as error:
            failure = error
        if self._camera.IsCameraDeviceRemoved():
            remedy = "connect it and open it again"
            raise base.Disconnected(self._name, operation, "it was removed", remedy) from failure
        if isinstance(failure, HardwareError):
            raise failure
        if failure is not None:
            raise self._error(operation, failure) from failure

    def _error(self, operation: str, failure: Exception) -> HardwareError:
        cause = str(failure).split(" : ")[0].rstrip(".")
        if isinstance(failure, genicam.TimeoutException):
            return self._timeout(operation, cause)
        if isinstance(failure, genicam.OutOfRangeException):
            return base.OutOfRange(self._name, operation, cause, "give a value within the limits")
        if operation == "open" and "another" in cause:
            return base.Busy(self._name, operation, cause, "close the program that holds it")
        if operation == "open" and "permission" in cause.lower():
            remedy = "install pylon's udev rule (setup-usb.sh) and connect the camera again"
            return base.PermissionDenied(self._name, operation, cause, remedy)
        return base.ProtocolError(self._name, operation, cause, "open the camera again")


class _Features:
    """The nodes of a pylon camera."""

    def __init__(self, nodes: Any):
        self._nodes = nodes

    def has(self, name: str) -> bool:
        return genicam.IsAvailable(self._nodes.GetNode(name))

    def get(self, name: str) -> Value:
        return self._nodes.GetNode(name).Value

    def set(self, name: str, value: Value) -> None:
        self._nodes.GetNode(name).Value = value

    def limits(self, name: str) -> tuple[Number, Number, Number]:
        node = self._nodes.GetNode(name)
        step = node.Inc if isinstance(node, genicam.IInteger) else 0.0
        return node.Min, node.Max, step

    def choices(self, name: str) -> tuple[str, ...]:
        return tuple(self._nodes.GetNode(name).Symbolics) if self.has(name) else ()
