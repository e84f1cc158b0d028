"""A virtual USB3 Vision camera behind pyusb's backend interface.

With this backend a client finds one camera on the bus, with descriptors, GenCP, an XML of features,
leader, payload and trailer as of a real one. The frames come from a function, at the trigger and
without delay.
"""

import errno
import struct
from array import array
from collections import deque
from collections.abc import Callable
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from types import SimpleNamespace
from typing import Any

import numpy as np
from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

from thincam_jax.hardware.base import CameraSettings, Region
from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm, Command, Sbrm, Sirm, Status
from thincam_jax.hardware.cameras.usb3_vision.stream import (
    IMAGE,
    LEADER,
    LEADER_MAGIC,
    PIXEL_FORMATS,
    TRAILER,
    TRAILER_MAGIC,
    frame_bytes,
)
from thincam_jax.hardware.virtual.devices import Faults

CONTROL_OUT, CONTROL_IN, STREAM_IN = 0x01, 0x81, 0x82
LATE = 0.02  # s
MOST_FRAMES = 8  # in the camera's memory; more are lost
DATA_OVERRUN = 0xA101  # status of a trailer

SBRM, SIRM, MANIFEST, FEATURES, XML = 0x1000, 0x1100, 0x1200, 0x2000, 0x10000
# Registers of the features, as usb3_vision.xml has them.
(SENSOR_WIDTH, SENSOR_HEIGHT, WIDTH, HEIGHT, LEFT, TOP, PIXEL_FORMAT, PAYLOAD_SIZE) = range(
    FEATURES, FEATURES + 0x20, 4
)
EXPOSURE, GAIN, FRAME_RATE = range(FEATURES + 0x20, FEATURES + 0x38, 8)  # float64: µs, dB, Hz
ACQUISITION_MODE, START, STOP, TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER = range(
    FEATURES + 0x40, FEATURES + 0x5C, 4
)
LINE0, LINE_PERIOD = 1, 0.02  # value of TriggerSource, 0 is Software; s between pulses
LIMITS = {EXPOSURE: (10.0, 1e7), GAIN: (0.0, 24.0), FRAME_RATE: (0.1, 1000.0)}
LEAST_SIZE = 16

# By their index in descriptors: language, vendor, model, serial, GUID, version, about the vendor.
STRINGS = ("", "thincam_jax", "Virtual camera", "", "CAFE00000001", "1.0", "no hardware")


def _descriptor(kind: str, *values: int, extra: bytes = b"") -> tuple[SimpleNamespace, bytes]:
    """A USB descriptor as pyusb reads it and as bytes; its first field is its length."""
    layout, names = {
        "device": (
            "<BBHBBBBHHHBBBB",
            "bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 "
            "idVendor idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations",
        ),
        "configuration": (
            "<BBHBBBBB",
            "bDescriptorType wTotalLength bNumInterfaces bConfigurationValue iConfiguration "
            "bmAttributes bMaxPower",
        ),
        "interface": (
            "<9B",
            "bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass "
            "bInterfaceSubClass bInterfaceProtocol iInterface",
        ),
        "endpoint": (
            "<BBBBHB",
            "bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval",
        ),
    }[kind]
    length = struct.calcsize(layout)
    fields = dict(zip(("bLength", *names.split()), (length, *values), strict=True))
    record = SimpleNamespace(
        **fields, bRefresh=0, bSynchAddress=0, extra_descriptors=array("B", extra)
    )
    return record, struct.pack(layout, length, *values) + extra


# Companion of a SuperSpeed endpoint; association of the two interfaces; what U3V adds to the first.
_COMPANION = bytes((6, 0x30, 0, 0, 0, 0))
_ASSOCIATION = bytes((8, 0x0B, 0, 2, 0xEF, 0x05, 0x00, 0))
_U3V_INFO = struct.pack("<BBBII9B", 20, 0x24, 1, 0x0001_0003, 0x0001_0002,
                        4, 1, 2, 0, 5, 6, 3, 0, 0x08)  # fmt: skip
_DEVICE, DEVICE_BYTES = _descriptor(
    "device", 1, 0x0300, 0xEF, 0x02, 0x01, 9, 0xCAFE, 0x0001, 0x0100, 1, 2, 3, 1
)
_INTERFACES = (
    _descriptor("interface", 4, 0, 0, 2, 0xEF, 0x05, 0x00, 0, extra=_U3V_INFO),
    _descriptor("interface", 4, 1, 0, 1, 0xEF, 0x05, 0x02, 0),
)
_ENDPOINTS = (
    (
        _descriptor("endpoint", 5, CONTROL_OUT, 2, 1024, 0, extra=_COMPANION),
        _descriptor("endpoint", 5, CONTROL_IN, 2, 1024, 0, extra=_COMPANION),
    ),
    (_descriptor("endpoint", 5, STREAM_IN, 2, 1024, 0, extra=_COMPANION),),
)
_BODY = _ASSOCIATION + b"".join(
    interface + b"".join(endpoint for _, endpoint in endpoints)
    for (_, interface), endpoints in zip(_INTERFACES, _ENDPOINTS, strict=True)
)
_CONFIGURATION, _head = _descriptor("configuration", 2, 9 + len(_BODY), 2, 1, 0, 0x80, 112)
CONFIGURATION_BYTES = _head + _BODY
_DEVICE.__dict__.update(address=1, bus=1, port_number=1, port_numbers=(1,), speed=4)


class _Refused(Exception):
    """A command is refused with this status."""


class VirtualUsb3Vision(IBackend):
    """One virtual camera on a bus of its own; give it to pyusb as the backend.

    `expose(settings)` returns the counts (y, x), uint16, of the frame exposed at the trigger, of
    the size of `settings.region`, in an array not changed afterwards. With TriggerMode Off frames
    are exposed when the client reads, at AcquisitionFrameRate; with TriggerSource Line0, at pulses
    of an external clock, `LINE_PERIOD` s apart. Nothing is connected to Line1.
    """

    def __init__(
        self,
        expose: Callable[[CameraSettings], np.ndarray],
        sensor_shape: tuple[int, int] = (2048, 2048),
        serial: str = "0001",
        faults: Faults | None = None,
    ):
        self.faults = faults or Faults()
        self._expose, self._shape, self._serial = expose, sensor_shape, serial
        self._xml = Path(__file__).with_suffix(".xml").read_bytes()
        self._power_on()

    def _power_on(self) -> None:
        self._claims: dict[int, object] = {}
        self._open: list[object] = []  # handles; those from before an unplug are dead
        self._answers: deque[tuple[float, bytes]] = deque()
        self._frames: deque[tuple[float, memoryview]] = deque()
        self._waiting, self._block, self._acquiring = 0, 0, False
        self._due = 0.0  # when a camera that is not triggered by software has its next frame
        self._last: tuple[memoryview, ...] = ()
        memory = self._memory = bytearray(XML) + self._xml + bytes(-len(self._xml) % 4)
        texts = {Abrm.MANUFACTURER: STRINGS[1], Abrm.MODEL: STRINGS[2],
                 Abrm.SERIAL: self._serial, Abrm.DEVICE_VERSION: STRINGS[5]}  # fmt: skip
        for address, text in texts.items():
            memory[address : address + len(text)] = text.encode()
        rows, columns = self._shape
        for address, layout, *values in (
            (Abrm.VERSION, "<I", 0x0001_0003),
            (Abrm.CAPABILITY, "<Q", gencp.HAS_TIMESTAMP | gencp.HAS_SBRM),
            (Abrm.RESPONSE_TIME, "<I", 500),
            (Abrm.MANIFEST, "<QQ", MANIFEST, SBRM),
            (SBRM + Sbrm.VERSION, "<IQ", 0x0001_0002, gencp.HAS_SIRM),
            (SBRM + Sbrm.MAX_COMMAND, "<IIIQI", 1024, 1024, 1, SIRM, gencp.SIRM_LENGTH),
            (SBRM + Sbrm.CURRENT_SPEED, "<I", 0x08),
            (SIRM + Sirm.REQUIRED_LEADER, "<II", LEADER.size, TRAILER.size + 4),
            (MANIFEST, "<QIIQQ", 1, 0x0100_0000, 0x0101 << 16, XML, len(self._xml)),
            (SENSOR_WIDTH, "<6I", columns, rows, columns, rows, 0, 0),
            (PIXEL_FORMAT, "<I", PIXEL_FORMATS["Mono8"][0]),
            (EXPOSURE, "<ddd", 1e4, 0.0, 50.0),
        ):
            struct.pack_into(layout, memory, address, *values)
        self._derive()

    def _number(self, address: int) -> int:
        return struct.unpack_from("<I", self._memory, address)[0]

    def _frame_time(self) -> float:
        """Seconds between frames without a software trigger, inf where there are none."""
        if not self._number(TRIGGER_MODE):
            return 1 / struct.unpack_from("<d", self._memory, FRAME_RATE)[0]
        return LINE_PERIOD if self._number(TRIGGER_SOURCE) == LINE0 else np.inf

    @property
    def settings(self) -> CameraSettings:
        """Present settings of the camera."""
        exposure, gain = struct.unpack_from("<dd", self._memory, EXPOSURE)
        region = Region(*(self._number(a) for a in (TOP, LEFT, HEIGHT, WIDTH)))
        names = {code: name for name, (code, _) in PIXEL_FORMATS.items()}
        return CameraSettings(exposure * 1e-6, region, names[self._number(PIXEL_FORMAT)], gain)

    def _derive(self) -> None:
        settings = self.settings
        assert settings.region is not None
        size = frame_bytes(settings.pixel_format, settings.region)
        struct.pack_into("<I", self._memory, PAYLOAD_SIZE, size)
        struct.pack_into("<Q", self._memory, SIRM + Sirm.REQUIRED_PAYLOAD, size)

    def _command(self, packet: bytes) -> None:
        """Answer a command; anything else is ignored."""
        try:
            command = gencp.decode(packet)
        except ValueError:
            return
        ready = 0.0
        try:
            if self.faults.due("busy"):
                raise _Refused(Status.BUSY)
            if self.faults.due("nak"):
                raise _Refused(Status.ACCESS_DENIED)
            if command.data[:8] == gencp.ADDRESS.pack(TRIGGER) and self.faults.due("latency"):
                ready = monotonic() + LATE
                pending = gencp.RESERVED_AND_NUMBER.pack(0, round(LATE * 2000))
                self._answers.append((0.0, gencp.answer(Command.PENDING, command.request, pending)))
            data = self._obey(command, ready)
            status = Status.SUCCESS
        except _Refused as refusal:
            data, (status,) = b"", refusal.args
        self._answers.append(
            (ready, gencp.answer(command.command + 1, command.request, data, status))
        )

    def _obey(self, command: gencp.Packet, ready: float) -> bytes:
        if command.command == Command.READ and len(command.data) == gencp.ADDRESSED_READ.size:
            address, _, length = gencp.ADDRESSED_READ.unpack(command.data)
            if address + length > len(self._memory):
                raise _Refused(Status.INVALID_ADDRESS)
            return bytes(self._memory[address : address + length])
        if command.command != Command.WRITE or len(command.data) <= gencp.ADDRESS.size:
            raise _Refused(Status.NOT_IMPLEMENTED)
        (address,) = gencp.ADDRESS.unpack_from(command.data)
        data = command.data[gencp.ADDRESS.size :]
        if address in LIMITS and len(data) == 8:
            low, high = LIMITS[address]
            if not low <= struct.unpack("<d", data)[0] <= high:
                raise _Refused(Status.INVALID_PARAMETER)
            self._memory[address : address + 8] = data
        elif len(data) == 4:
            self._set_number(address, int.from_bytes(data, "little"), ready)
        else:
            raise _Refused(Status.BAD_ALIGNMENT)
        return gencp.RESERVED_AND_NUMBER.pack(0, len(data))

    def _set_number(self, address: int, value: int, ready: float) -> None:
        if address in (WIDTH, HEIGHT, LEFT, TOP, PIXEL_FORMAT):
            if self._acquiring:
                raise _Refused(Status.ACCESS_DENIED)
            self._check_geometry(address, value)
        elif address == TRIGGER:
            if not self._number(TRIGGER_SOURCE):
                self._expose_frame(ready and ready + LATE)  # the frame is later than the answer
        elif address == START:
            self._acquiring, self._block = True, 0
            self._due = monotonic() + min(self._frame_time(), LINE_PERIOD)
        elif address == STOP:
            self._acquiring = False
        elif address == Abrm.TIMESTAMP_LATCH:
            struct.pack_into("<Q", self._memory, Abrm.TIMESTAMP, monotonic_ns())
        elif address == SIRM + Sirm.CONTROL:
            if not value & 1:
                self._frames.clear()
                self._waiting = 0
        elif address not in (ACQUISITION_MODE, TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE) and (
            not SIRM + Sirm.MAX_LEADER <= address <= SIRM + Sirm.MAX_TRAILER
        ):
            raise _Refused(Status.WRITE_PROTECT)
        struct.pack_into("<I", self._memory, address, value)
        self._derive()

    def _check_geometry(self, address: int, value: int) -> None:
        if address == PIXEL_FORMAT:
            allowed = value in [code for code, _ in PIXEL_FORMATS.values()]
        else:
            sensor, other = {
                WIDTH: (SENSOR_WIDTH, LEFT),
                LEFT: (SENSOR_WIDTH, WIDTH),
                HEIGHT: (SENSOR_HEIGHT, TOP),
                TOP: (SENSOR_HEIGHT, HEIGHT),
            }[address]
            least, step = (LEAST_SIZE if address in (WIDTH, HEIGHT) else 0), 4
            most = self._number(sensor) - self._number(other)
            allowed = least <= value <= most and not value % step
        if not allowed:
            raise _Refused(Status.INVALID_PARAMETER)

    def _expose_frame(self, ready: float = 0.0) -> None:
        streaming = self._number(SIRM + Sirm.CONTROL) & 1
        if not self._acquiring:
            return
        settings, time = self.settings, monotonic_ns()
        assert settings.region is not None
        block, self._block = self._block, self._block + 1
        data = self._pack(settings, self._expose(settings))
        if not streaming or self._waiting >= MOST_FRAMES or self.faults.due("dropped_frame"):
            return
        if self._last and self.faults.due("stale_frame"):
            self._send(ready, self._last)
        region, code = settings.region, PIXEL_FORMATS[settings.pixel_format][0]
        place = (region.width, region.height, region.left, region.top)
        leader = LEADER.pack(
            LEADER_MAGIC, 0, LEADER.size, block, 0, IMAGE, time, code, *place, 0, 0
        )
        sent, status, valid = data, 0, len(data)
        if self.faults.due("short_frame"):
            sent = data[: len(data) // 2]
            if self.faults.happened["short_frame"] % 2:  # every second trailer hides it
                status, valid = DATA_OVERRUN, len(sent)
        trailer = TRAILER.pack(TRAILER_MAGIC, 0, TRAILER.size + 4, block, status, 0, valid)
        trailer += struct.pack("<I", region.height)
        frame = (memoryview(leader), sent, memoryview(trailer))
        self._send(ready, frame)
        self._last = frame

    def _send(self, ready: float, frame: tuple[memoryview, ...]) -> None:
        self._frames.extend((ready, transfer) for transfer in frame)
        self._waiting += 1

    def _pack(self, settings: CameraSettings, counts: np.ndarray) -> memoryview:
        """The bytes of a frame on the wire."""
        region = settings.region
        assert region is not None
        if counts.shape != (region.height, region.width) or counts.dtype != np.uint16:
            raise ValueError(
                f"expose returned {counts.dtype} of shape {counts.shape}; it has to return uint16 "
                f"of {(region.height, region.width)}"
            )
        if PIXEL_FORMATS[settings.pixel_format][1] == 8:
            counts = counts.astype(np.uint8)
        elif settings.pixel_format.endswith("p"):
            pairs = np.append(counts, np.zeros(counts.size % 2, np.uint16)).reshape(-1, 2)
            even, odd = pairs[:, 0], pairs[:, 1]
            counts = np.empty((len(pairs), 3), np.uint8)
            for part, bits in enumerate((even, even >> 8 | odd << 4, odd >> 4)):
                counts[:, part] = bits.astype(np.uint8)
        wire = np.ascontiguousarray(counts, "<u2" if counts.itemsize == 2 else np.uint8)
        data = wire.reshape(-1).view(np.uint8).data
        return data[: frame_bytes(settings.pixel_format, region)]

    def enumerate_devices(self) -> Any:
        return iter((self,))

    def get_device_descriptor(self, dev: object) -> Any:
        return _DEVICE

    def get_configuration_descriptor(self, dev: object, config: int) -> Any:
        if config:
            raise IndexError(f"no configuration {config}")
        return _CONFIGURATION

    def get_interface_descriptor(self, dev: object, intf: int, alt: int, config: int) -> Any:
        if intf > 1 or alt:
            raise IndexError(f"no interface {intf}, {alt}")
        return _INTERFACES[intf][0]

    def get_endpoint_descriptor(
        self, dev: object, ep: int, intf: int, alt: int, config: int
    ) -> Any:
        return _ENDPOINTS[intf][ep][0]

    def open_device(self, dev: object) -> Any:
        handle = object()
        self._open.append(handle)
        return handle

    def close_device(self, dev_handle: object) -> None:
        self._claims = {n: owner for n, owner in self._claims.items() if owner is not dev_handle}
        self._open = [handle for handle in self._open if handle is not dev_handle]

    def get_configuration(self, dev_handle: object) -> Any:
        self._alive(dev_handle)
        return 1

    def set_configuration(self, dev_handle: object, config_value: int) -> None:
        self._alive(dev_handle)

    def set_interface_altsetting(self, dev_handle: object, intf: int, altsetting: int) -> None:
        self._alive(dev_handle)

    def claim_interface(self, dev_handle: object, intf: int) -> None:
        self._alive(dev_handle)
        if self._claims.setdefault(intf, dev_handle) is not dev_handle:
            raise USBError("Resource busy", errno=errno.EBUSY)

    def release_interface(self, dev_handle: object, intf: int) -> None:
        if self._claims.get(intf) is dev_handle:
            del self._claims[intf]

    def clear_halt(self, dev_handle: object, ep: int) -> None:
        self._alive(dev_handle)

    def ctrl_transfer(
        self,
        dev_handle: object,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array,
        timeout: int,
    ) -> Any:
        """Return descriptors; a standard request without data does nothing."""
        self._alive(dev_handle)
        if not bmRequestType & 0x80:
            return 0
        kind, index = wValue >> 8, wValue & 0xFF
        if kind == 1:
            answer = DEVICE_BYTES
        elif kind == 2:
            answer = CONFIGURATION_BYTES
        elif kind == 3 and index < len(STRINGS):
            text = self._serial if index == 3 else STRINGS[index]
            content = text.encode("utf-16-le") if index else struct.pack("<H", 0x0409)
            answer = bytes((len(content) + 2, 3)) + content
        else:
            raise USBError("Pipe error", errno=errno.EPIPE)
        count = min(len(answer), len(data))
        data[:count] = array("B", answer[:count])
        return count

    def bulk_write(self, dev_handle: object, ep: int, intf: int, data: array, timeout: int) -> Any:
        self._alive(dev_handle)
        self._command(data.tobytes())
        return len(data)

    def bulk_read(self, dev_handle: object, ep: int, intf: int, buff: array, timeout: int) -> Any:
        """Read the next transfer, or as much as fits, within `timeout` ms."""
        self._alive(dev_handle)
        queue: deque[tuple[float, Any]] = self._answers if ep == CONTROL_IN else self._frames
        if ep == STREAM_IN and not queue and self._acquiring and self._frame_time() < np.inf:
            self._expose_frame(self._due)
            self._due = max(self._due, monotonic()) + self._frame_time()
        wait = queue[0][0] - monotonic() if queue else np.inf
        if wait > 0:
            sleep(min(wait, timeout * 1e-3))
            self._alive(dev_handle)
            if wait > timeout * 1e-3:
                raise USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        ready, transfer = queue.popleft()
        count = min(len(transfer), len(buff))
        memoryview(buff)[:count] = transfer[:count]
        if count < len(transfer):
            queue.appendleft((ready, transfer[count:]))
        elif ep == STREAM_IN and not len(queue) % 3:
            self._waiting = len(queue) // 3
        return count

    def _alive(self, dev_handle: object) -> None:
        """Raise for a handle from before an unplug; each call may be the moment of that fault."""
        if self.faults.due("unplug"):
            self._power_on()
        if dev_handle not in self._open:
            raise USBError("No such device", errno=errno.ENODEV)
