"""The USB side of a USB3 Vision camera: find it, claim it, transfer; and GenCP over it.

Whatever pyusb raises becomes a `HardwareError`; every transfer has a time limit.
"""

import errno
import struct
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from time import monotonic, sleep
from typing import Any

import usb.core
import usb.util

from thincam_jax.hardware.base import (
    Busy,
    Disconnected,
    HardwareError,
    NotFound,
    OutOfRange,
    PermissionDenied,
    ProtocolError,
    Timeout,
)
from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm, Command, Sbrm, Status
from thincam_jax.hardware.holder import holder

# Class, subclass and protocol of the two interfaces that every USB3 Vision camera has.
CONTROL_INTERFACE = (0xEF, 0x05, 0x00)
STREAM_INTERFACE = (0xEF, 0x05, 0x02)

LONGEST_ANSWER = 10.0  # s, with all pending acknowledges and repetitions
LONGEST_READ = 60.0  # s, of the whole XML
LARGEST_READ = 16 << 20  # bytes
LARGEST_PACKET = 64 << 10
GONE = (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN, errno.EIO, errno.ENXIO)


def _interface(device: Any, wanted: tuple[int, int, int]) -> Any:
    with suppress(usb.core.USBError):  # of a device that cannot be read
        for configuration in device:
            for interface in configuration:
                if wanted == (interface.bInterfaceClass, interface.bInterfaceSubClass,
                              interface.bInterfaceProtocol):  # fmt: skip
                    return interface
    return None


def _endpoint(interface: Any, direction: int) -> Any:
    for end in interface:
        if (
            usb.util.endpoint_direction(end.bEndpointAddress) == direction
            and usb.util.endpoint_type(end.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
        ):
            return end.bEndpointAddress
    return None


def cameras_there(name: str = "USB3 Vision cameras", backend: Any = None) -> list[Any]:
    """Every USB3 Vision camera, unopened; NotFound where USB cannot be listed."""
    try:
        devices = usb.core.find(
            find_all=True,
            backend=backend,
            custom_match=lambda d: (
                _interface(d, CONTROL_INTERFACE) is not None
                and _interface(d, STREAM_INTERFACE) is not None
            ),
        )
        return list(devices or ())
    except usb.core.NoBackendError as error:
        remedy = "install libusb 1.0 (Debian: apt install libusb-1.0-0)"
        raise NotFound(name, "open", "libusb is not installed", remedy) from error
    except usb.core.USBError as error:
        remedy = "check that this system has USB"
        raise NotFound(name, "open", f"USB cannot be listed: {error}", remedy) from error


class UsbLink:
    """A claimed USB3 Vision camera and its three bulk endpoints."""

    def __init__(self, serial: str = "", backend: Any = None):
        """Claim the camera of this serial number, or the only one; by libusb without a backend."""
        self.name = f"USB3 Vision camera {serial}".rstrip()
        candidates = cameras_there(self.name, backend)
        if not serial and len(candidates) == 1:
            (self._device,) = candidates
        else:
            self._device = self._of_serial(serial, candidates)
        control, stream = (
            _interface(self._device, kind) for kind in (CONTROL_INTERFACE, STREAM_INTERFACE)
        )
        ends = (
            _endpoint(control, usb.util.ENDPOINT_OUT),
            _endpoint(control, usb.util.ENDPOINT_IN),
            _endpoint(stream, usb.util.ENDPOINT_IN),
        )
        if None in ends:
            raise self.broken("open", "it lacks a bulk endpoint of USB3 Vision")
        self.control_out, self.control_in, self.stream_in = ends
        try:
            with self._named("open"):
                for interface in (control, stream):
                    usb.util.claim_interface(self._device, interface.bInterfaceNumber)
        except HardwareError:
            self.close()
            raise

    def _of_serial(self, serial: str, candidates: list[Any]) -> Any:
        known = {}
        for self._device in candidates:
            with self._named("open"):
                known[self._device.serial_number or ""] = self._device
        if serial in known and serial:
            return known[serial]
        if not known:
            raise NotFound(self.name, "open", "no USB3 Vision camera is connected",
                           "check cable and power; lsusb lists what is there")  # fmt: skip
        raise NotFound(self.name, "open", f"connected are {', '.join(known)}",
                       "give the serial number of one of them")  # fmt: skip

    @contextmanager
    def _named(self, operation: str) -> Iterator[None]:
        """Turn errors of pyusb into those of a device."""
        try:
            yield
        except usb.core.USBTimeoutError as error:
            raise Timeout(self.name, operation, "no answer in time",
                          "check cable and power, or allow more time") from error  # fmt: skip
        except ValueError as error:  # pyusb without permission: "no langid"
            raise self._refused(operation, error) from error
        except usb.core.USBError as error:
            if error.errno == errno.EACCES:
                raise self._refused(operation, error) from error
            if error.errno == errno.EBUSY:
                node = f"/dev/bus/usb/{self._device.bus or 0:03d}/{self._device.address or 0:03d}"
                cause = f"{holder(node, others=True)} has it open"
                raise Busy(self.name, operation, cause, "close that program") from error
            if error.errno in GONE:
                remedy = "check cable and power, then open it again"
                raise Disconnected(self.name, operation, "the camera has gone", remedy) from error
            raise self.broken(operation, str(error)) from error

    def _refused(self, operation: str, error: Exception) -> PermissionDenied:
        rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{self._device.idVendor:04x}", TAG+="uaccess"'
        return PermissionDenied(
            self.name, operation, f"this user may not open it ({error})",
            f"write {rule} to /etc/udev/rules.d/70-usb3-vision.rules and plug it in again",
        )  # fmt: skip

    def broken(self, operation: str, cause: str) -> ProtocolError:
        """Error for a violation of the USB3 Vision standard."""
        return ProtocolError(self.name, operation, cause, "switch the camera off and on again")

    def send(self, data: bytes, operation: str) -> None:
        """Write to the control endpoint."""
        with self._named(operation):
            self._device.write(self.control_out, data, 1000)

    def receive(self, endpoint: int, buffer: array, timeout: float, operation: str) -> int:
        """Read one transfer into `buffer` and return its length; `timeout` in s."""
        with self._named(operation):
            try:
                return self._device.read(endpoint, buffer, max(1, round(timeout * 1000)))
            except usb.core.USBError as error:
                if error.errno == errno.EPIPE:  # halted by the camera; make it usable again
                    self._device.clear_halt(endpoint)
                raise

    def clear_halt(self, endpoint: int) -> None:
        """Reset an endpoint."""
        with self._named("reset an endpoint"):
            self._device.clear_halt(endpoint)

    def close(self) -> None:
        """Release the camera."""
        with suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)


class CameraMemory:
    """Read and write the camera's memory with GenCP."""

    def __init__(self, link: UsbLink):
        self._link, self._request = link, 0
        self._patience = 1.0  # s for one answer, until the camera's own response time is read
        self._largest_command = self._largest_answer = gencp.HEADER.size + gencp.TEXT_LENGTH
        self._buffer = array("B", bytes(LARGEST_PACKET + 1024))
        with suppress(Timeout):  # a stale answer to a client that was killed
            link.receive(link.control_in, self._buffer, 0.001, "open")
        self._patience = min(max(self.read_number(Abrm.RESPONSE_TIME) * 1e-3, 0.2), 5.0)
        self.has_clock = bool(self.read_number(Abrm.CAPABILITY, 8) & gencp.HAS_TIMESTAMP)
        sbrm = self.read_number(Abrm.SBRM, 8)
        if not self.read_number(sbrm + Sbrm.CAPABILITY, 8) & gencp.HAS_SIRM:
            raise link.broken("open", "it has no stream")
        largest = [self.read_number(sbrm + r) for r in (Sbrm.MAX_COMMAND, Sbrm.MAX_ACKNOWLEDGE)]
        if min(largest) < 32:
            raise link.broken("open", f"packets of {min(largest)} bytes can carry nothing")
        self._largest_command, self._largest_answer = (min(n, LARGEST_PACKET) for n in largest)
        self.sirm = self.read_number(sbrm + Sbrm.SIRM, 8)

    def read(self, address: int, length: int) -> bytes:
        """Read `length` bytes from `address`, in as many packets as needed."""
        self._check(address, length, "read")
        step = self._largest_answer - gencp.HEADER.size & ~3
        parts, end = [], monotonic() + LONGEST_READ
        for start in range(0, length, step):
            size = min(step, length - start)
            encode = partial(gencp.read_command, address + start, size)
            operation = f"read {size} bytes at {address + start:#x}"
            data = self._exchange(encode, Command.READ_ACKNOWLEDGE, operation)
            if len(data) != size:
                raise self._link.broken(operation, f"{len(data)} bytes came")
            if monotonic() > end:
                cause = f"{start + size} bytes came in {LONGEST_READ:g} s"
                raise Timeout(self._link.name, f"read {length} bytes", cause, "try again")
            parts.append(data)
        return b"".join(parts)

    def write(self, address: int, data: bytes) -> None:
        """Write `data` to `address`, in as many packets as needed."""
        self._check(address, len(data), "write")
        step = self._largest_command - gencp.HEADER.size - gencp.ADDRESS.size & ~3
        for start in range(0, len(data), step):
            encode = partial(gencp.write_command, address + start, data[start : start + step])
            operation = f"write at {address + start:#x}"
            self._exchange(encode, Command.WRITE_ACKNOWLEDGE, operation)

    def _check(self, address: int, length: int, verb: str) -> None:
        """Refuse impossible addresses and lengths, which come from the camera's XML."""
        if not (0 <= length <= LARGEST_READ and 0 <= address <= 2**64 - length):
            raise self._link.broken(f"{verb} at {address:#x}", f"{length} bytes are not possible")

    def read_number(self, address: int, length: int = 4) -> int:
        """Read an unsigned register."""
        return int.from_bytes(self.read(address, length), "little")

    def write_number(self, address: int, value: int) -> None:
        """Write a register of four bytes."""
        self.write(address, struct.pack("<I", value))

    def clock(self) -> int:
        """Present time of the camera's clock, in ns."""
        self.write_number(Abrm.TIMESTAMP_LATCH, 1)
        return self.read_number(Abrm.TIMESTAMP, 8)

    def _exchange(self, encode: Callable[[int], bytes], wanted: int, operation: str) -> bytes:
        """Send a command, repeated while the camera is busy, and return the answer's data."""
        end = monotonic() + LONGEST_ANSWER
        while True:
            self._request = self._request % 0xFFFF + 1
            self._link.send(encode(self._request), operation)
            answer = self._answer(wanted, operation, end)
            if answer.status == Status.SUCCESS:
                return answer.data
            cause = f"the camera answers {gencp.status_name(answer.status)}"
            if answer.status == Status.INVALID_PARAMETER:
                raise OutOfRange(self._link.name, operation, cause, "ask for another value")
            if answer.status != Status.BUSY:
                raise ProtocolError(self._link.name, operation, cause,
                                    "configure the camera again")  # fmt: skip
            if monotonic() > end:
                raise Timeout(self._link.name, operation, cause, "try again later")
            sleep(0.002)

    def _answer(self, wanted: int, operation: str, end: float) -> gencp.Packet:
        """Answer to the last request; those to earlier ones are skipped."""
        deadline = min(monotonic() + self._patience, end)
        while (left := deadline - monotonic()) > 0:
            count = self._link.receive(self._link.control_in, self._buffer, left, operation)
            try:
                packet = gencp.decode(memoryview(self._buffer)[:count])
                if packet.request != self._request:
                    continue
                if packet.command == Command.PENDING:
                    deadline = min(monotonic() + gencp.pending_time(packet), end)
                    continue
                # A refusal may repeat the command's own number.
                if packet.command != wanted and packet.status == Status.SUCCESS:
                    raise ValueError(f"{packet.command:#06x} instead of {wanted:#06x}")
            except ValueError as error:
                raise self._link.broken(operation, f"the answer is none: {error}") from error
            return packet
        raise Timeout(self._link.name, operation, "no answer in time",
                      "check cable and power")  # fmt: skip
