"""GigE Vision and USB3 Vision cameras by aravis, through GObject introspection."""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

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

_BUFFERS = 4
# Devices with a control interface of USB3 Vision, for the user at the machine.
_RULE = 'SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:ef0500:*", TAG+="uaccess"'


class AravisCamera(FeatureCamera):
    """A camera supported by aravis, with one frame for each trigger.

    After a failed frame the stream is restarted, so that a late one is not taken for the next. A
    camera that does not answer for 2.5 s is `Disconnected`.
    """

    @dataclass(frozen=True)
    class Options:
        """`name`: name that `arv-tool-0.8` lists, the camera's address, or "" for the first one."""

        name: str = ""

    def __init__(self, options: Options):
        self._aravis, self._glib = _libraries()
        self._name, self._lost = options.name or "aravis camera", False
        self._camera: Any = None
        self._stream: Any = None
        self._features: Any = None
        self._count = FrameCount()
        try:
            with self._translated("open"):
                # The list is that of the last search, without cameras connected since.
                self._aravis.update_device_list()
                self._camera = self._aravis.Camera.new(options.name or None)
                self._introduce()
        except BaseException:
            self.close()
            raise

    @staticmethod
    def require_libraries() -> None:
        """Raise NotFound, with what to install, where libraries are missing."""
        _libraries()

    @classmethod
    def connected(cls) -> list[Connected]:
        aravis, _ = _libraries()
        aravis.update_device_list()
        return [
            Connected(
                "camera",
                "aravis",
                {"name": aravis.get_device_id(n)},
                f"{aravis.get_device_vendor(n)} {aravis.get_device_model(n)}",
            )
            for n in range(aravis.get_n_devices())
        ]

    def _introduce(self) -> None:
        device = self._camera.get_device()
        features = self._features = _Features(self._aravis, device)
        self.identity = Identity(
            self._camera.get_vendor_name(),
            self._camera.get_model_name(),
            self._camera.get_device_serial_number() or "",
            text(features, "DeviceFirmwareVersion") or text(features, "DeviceVersion"),
        )
        self._name = str(self.identity)
        if isinstance(device, self._aravis.GvDevice) and not device.is_controller():
            raise base.Busy(self._name, "open", "another program controls it", "close that program")
        device.connect("control-lost", self._on_control_lost)
        self._camera.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        trigger_by_software(features)

    def flush(self) -> None:
        while self._stream is not None:
            buffer = self._stream.try_pop_buffer()
            if buffer is None:
                return
            self._stream.push_buffer(buffer)

    def trigger_and_grab(self, timeout: float) -> Frame:
        settings = self._require_settings()
        deadline = time.monotonic() + settings.exposure + timeout
        try:
            with self._translated("grab"):
                if self._external:
                    self._stop()  # with frames that are exposed already
                self._start()
                self.flush()
                if not self._external:
                    self._wait_until_ready(deadline)
                    self._features.execute("TriggerSoftware")
                left = max(deadline - time.monotonic(), 0.0)
                buffer = self._stream.timeout_pop_buffer(int(1e6 * left))
                if buffer is None:
                    raise self._no_frame(timeout)
                frame = self._frame(buffer, settings)
                self._stream.push_buffer(buffer)
                return frame
        except BaseException:
            self._stop()
            raise

    def close(self) -> None:
        self._stop()
        self._camera = self._features = None

    def _start(self) -> None:
        if self._stream is not None:
            return
        self._stream = self._camera.create_stream(None, None)
        payload = self._camera.get_payload()
        for _ in range(_BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
        if self._features.has("AcquisitionStatusSelector"):
            self._features.set("AcquisitionStatusSelector", "FrameTriggerWait")
        self._count.restart()
        self._camera.start_acquisition()

    def _stop(self) -> None:
        if self._stream is not None and not self._lost:  # a lost one takes seconds to refuse
            with suppress(self._glib.Error):
                self._camera.stop_acquisition()
        self._stream = None

    def _wait_until_ready(self, deadline: float) -> None:
        """Wait, as early triggers are lost; some cameras report when they are ready."""
        while self._features.has("AcquisitionStatus"):
            if self._features.get("AcquisitionStatus"):
                return
            if time.monotonic() > deadline:
                raise self._timeout("grab", "the camera was not ready for a trigger")

    def _frame(self, buffer: Any, settings: CameraSettings) -> Frame:
        status = buffer.get_status()
        if status != self._aravis.BufferStatus.SUCCESS:
            cause = f"packets are missing ({status.value_nick})"
            raise base.IncompleteFrame(
                self._name, "grab", cause, "take it again; check the network"
            )
        data, region = buffer.get_data(), settings.region
        bits = BIT_DEPTHS[settings.pixel_format]
        pixels = np.frombuffer(data, np.uint8 if bits == 8 else np.dtype("<u2"))
        if region is None or pixels.size != region.height * region.width:
            cause = f"{len(data)} bytes, and {region} of {settings.pixel_format} is set"
            raise base.IncompleteFrame(self._name, "grab", cause, "take it again")
        number = self._count.number(buffer.get_frame_id())
        shaped = pixels.reshape(region.height, region.width)
        return Frame(shaped, number, 1e-9 * buffer.get_timestamp(), settings.exposure, bits)

    def _on_control_lost(self, *_: Any) -> None:
        self._lost = True

    @contextmanager
    def _translated(self, operation: str) -> Iterator[None]:
        """Turn errors of aravis into those of a device."""
        if self._lost:
            raise self._gone(operation, "its control was lost")
        try:
            yield
        except self._glib.Error as failure:
            raise self._error(operation, failure) from failure

    def _gone(self, operation: str, cause: str) -> base.Disconnected:
        return base.Disconnected(self._name, operation, cause, "connect it and open it again")

    def _error(self, operation: str, failure: Any) -> HardwareError:
        cause, codes = failure.message, self._aravis.DeviceError
        code = failure.code if "device-error" in failure.domain else None
        if code == codes.NOT_FOUND:
            found = [self._aravis.get_device_id(k) for k in range(self._aravis.get_n_devices())]
            remedy = f"connect one and switch it on; found: {', '.join(found) or 'none'}"
            return base.NotFound(self._name, operation, cause, remedy)
        if code in (codes.NOT_CONTROLLER, codes.PROTOCOL_ERROR_ACCESS_DENIED) or "BUSY" in cause:
            return base.Busy(self._name, operation, cause, "close the program that holds it")
        if "ACCESS" in cause:  # libusb's name for it
            remedy = f"write {_RULE} to /etc/udev/rules.d/70-usb3-vision.rules and plug it in again"
            return base.PermissionDenied(self._name, operation, cause, remedy)
        silent = codes.TIMEOUT, codes.NOT_CONNECTED, codes.TRANSFER_ERROR, codes.NO_STREAM_CHANNEL
        if code in silent:
            self._lost = True
            return self._gone(operation, cause)
        if "bounds" in cause or "out of range" in cause:
            return base.OutOfRange(self._name, operation, cause, "give a value within the limits")
        return base.ProtocolError(self._name, operation, cause, "open the camera again")


def _libraries() -> tuple[Any, Any]:
    """Aravis and GLib; NotFound where they are not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import_module("gi").require_version("Aravis", "0.8")
            return import_module("gi.repository.Aravis"), import_module("gi.repository.GLib")
    except (ImportError, ValueError) as error:
        remedy = (
            "apt-get install gir1.2-aravis-0.8 python3-gi, and a venv of the system's Python with "
            "--system-site-packages"
        )
        raise base.NotFound(
            "aravis", "open", f"its library is missing ({error})", remedy
        ) from error


class _Features:
    """The features of an aravis device."""

    def __init__(self, aravis: Any, device: Any):
        self._aravis, self._device = aravis, device

    def _is(self, name: str, *kinds: str) -> bool:
        node = self._device.get_feature(name)
        return isinstance(node, tuple(getattr(self._aravis, kind) for kind in kinds))

    def has(self, name: str) -> bool:
        return self._device.is_feature_available(name)

    def get(self, name: str) -> Value:
        if self._is(name, "GcBoolean"):
            return int(self._device.get_boolean_feature_value(name))
        if self._is(name, "GcEnumeration", "GcString"):
            return self._device.get_string_feature_value(name)
        if self._is(name, "GcFloat"):
            return self._device.get_float_feature_value(name)
        return self._device.get_integer_feature_value(name)

    def set(self, name: str, value: Value) -> None:
        if isinstance(value, str):
            self._device.set_string_feature_value(name, value)
        elif self._is(name, "GcFloat"):
            self._device.set_float_feature_value(name, value)
        else:
            self._device.set_integer_feature_value(name, int(value))

    def limits(self, name: str) -> tuple[Number, Number, Number]:
        if self._is(name, "GcFloat"):
            return *self._device.get_float_feature_bounds(name), 0.0
        low, high = self._device.get_integer_feature_bounds(name)
        return low, high, self._device.get_integer_feature_increment(name)

    def choices(self, name: str) -> tuple[str, ...]:
        if not self.has(name):
            return ()
        return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def execute(self, name: str) -> None:
        self._device.execute_command(name)
