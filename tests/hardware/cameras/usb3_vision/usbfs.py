"""A virtual camera as a device of the Linux kernel, for programs that know nothing of this project.

umockdev's preload library shows a program a made-up /sys and /dev, and passes its ioctl calls on to
a socket. Here stands what answers them: usbfs (linux/usbdevice_fs.h) in front of a backend.
"""

import errno
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
from array import array
from contextlib import contextmanager, suppress
from pathlib import Path

import usb.core

from thincam_jax.hardware.virtual.usb3_vision import (
    CONFIGURATION_BYTES,
    DEVICE_BYTES,
    VirtualUsb3Vision,
)

PRELOAD = Path("/usr/lib/x86_64-linux-gnu/libumockdev-preload.so.0")
NODE = "dev/bus/usb/001/001"
MESSAGE = struct.Struct("<QQQ")  # of umockdev: kind, argument, argument
IOCTL, DONE, READ_MEMORY, WRITE_MEMORY = 1, 3, 5, 6
URB = struct.Struct("<BBxxiI4xQiiiiiIQ")  # struct usbdevfs_urb
URB_CONTROL = 2
SUBMIT, DISCARD, REAP, REAP_NOW, CAPABILITIES = 10, 11, 12, 13, 26
OBEYED = (3, 4, 5, 15, 16, 20, 21, 27)  # claim, release, reset …
ONE_URB_A_TRANSFER = 0x04 | 0x08


class _Program:
    """One file descriptor that a program has opened."""

    def __init__(self, device: VirtualUsb3Vision, connection: socket.socket):
        self.device, self.handle, self.connection = device, device.open_device(device), connection
        self.pending: list[tuple[int, list]] = []  # (its address, its fields)
        self.done: list[int] = []

    def serve(self) -> None:
        with suppress(ConnectionError, EOFError):
            while True:
                kind, request, argument = MESSAGE.unpack(self._receive(MESSAGE.size))
                assert kind == IOCTL, kind
                try:
                    result = self.ioctl(request & 0xFF, argument)
                except usb.core.USBError as error:
                    self._send(DONE, 2**64 - 1, error.errno or errno.EIO)
                else:
                    self._send(DONE, result, 0)
        self.connection.close()
        self.device.close_device(self.handle)

    def ioctl(self, number: int, argument: int) -> int:
        if number == CAPABILITIES:
            self._write(argument, struct.pack("<I", ONE_URB_A_TRANSFER))
        elif number == SUBMIT:
            urb = list(URB.unpack(self._read(argument, URB.size)))
            if urb[0] == URB_CONTROL:
                self._control(argument, urb)
            elif urb[1] & 0x80:
                self.pending.append((argument, urb))
            else:
                data = array("B", self._read(urb[4], urb[5]))
                self._complete(
                    argument, urb, self.device.bulk_write(self.handle, urb[1], 0, data, 1)
                )
        elif number == DISCARD:
            for urb in self.pending:
                if urb[0] == argument:
                    self.pending.remove(urb)
                    self._complete(*urb, 0, -errno.ENOENT)
                    return 0
            raise usb.core.USBError("no such transfer", errno=errno.EINVAL)
        elif number in (REAP, REAP_NOW):
            if not self.done:
                self._transfer()
            if not self.done:
                raise usb.core.USBError("nothing yet", errno=errno.EAGAIN)
            self._write(argument, struct.pack("<Q", self.done.pop(0)))
        elif number not in OBEYED:
            raise usb.core.USBError("unknown", errno=errno.ENOTTY)
        return 0

    def _control(self, address: int, urb: list) -> None:
        setup = struct.unpack("<BBHHH", self._read(urb[4], 8))
        data = array("B", bytes(setup[4]))
        try:
            count = self.device.ctrl_transfer(self.handle, *setup[:4], data, 1)
        except usb.core.USBError as error:
            return self._complete(address, urb, 0, -(error.errno or errno.EIO))
        if setup[0] & 0x80 and count:
            self._write(urb[4] + 8, data[:count].tobytes())
        return self._complete(address, urb, count)

    def _transfer(self) -> None:
        """Reads for the first waiting transfer of each endpoint."""
        for endpoint in {urb[1] for _, urb in self.pending}:
            address, urb = next(entry for entry in self.pending if entry[1][1] == endpoint)
            data = array("B", bytes(urb[5]))
            with suppress(usb.core.USBTimeoutError):
                count = self.device.bulk_read(self.handle, endpoint, 0, data, 1)
                self._write(urb[4], memoryview(data)[:count])
                self.pending.remove((address, urb))
                self._complete(address, urb, count)

    def _complete(self, address: int, urb: list, count: int, status: int = 0) -> None:
        urb[2], urb[6] = status, count
        self._write(address, URB.pack(*urb))
        self.done.append(address)

    def _send(self, *numbers: int) -> None:
        self.connection.sendall(MESSAGE.pack(*numbers))

    def _receive(self, count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            if not (part := self.connection.recv(count - len(data))):
                raise EOFError
            data += part
        return bytes(data)

    def _read(self, address: int, count: int) -> bytes:
        self._send(READ_MEMORY, address, count)
        return self._receive(count)

    def _write(self, address: int, data: bytes | memoryview) -> None:
        if len(data):
            self._send(WRITE_MEMORY, address, len(data))
            self.connection.sendall(data)


def _show(root: Path) -> None:
    """Lays out what the kernel would show of the camera."""
    system = root / "sys/devices/usb1"
    attributes = {
        "busnum": "1\n", "devnum": "1\n", "speed": "5000\n", "bConfigurationValue": "1\n",
        "bNumConfigurations": "1\n", "idVendor": "cafe\n", "idProduct": "0001\n",
        "uevent": f"MAJOR=189\nMINOR=0\nDEVNAME={NODE[4:]}\nDEVTYPE=usb_device\n"
        "BUSNUM=001\nDEVNUM=001\n",
    }  # fmt: skip
    system.mkdir(parents=True)
    for name, text in attributes.items():
        (system / name).write_text(text, "utf-8")
    (system / "descriptors").write_bytes(DEVICE_BYTES + CONFIGURATION_BYTES)
    for path in ("sys/bus/usb/devices", "sys/class", "dev/.node", "run/udev/data", "ioctl"):
        (root / path).mkdir(parents=True)
    (root / "sys/bus/usb/devices/usb1").symlink_to("../../../devices/usb1")
    (system / "subsystem").symlink_to("../../bus/usb")
    node = root / NODE
    node.parent.mkdir(parents=True)
    node.write_bytes(DEVICE_BYTES + CONFIGURATION_BYTES)
    node.chmod(0o1644)  # by this umockdev knows a character device
    (root / "dev/.node" / NODE[4:].replace("/", "_")).symlink_to("189:0")
    (root / "ioctl" / NODE).parent.mkdir(parents=True)


@contextmanager
def presented(device: VirtualUsb3Vision):
    """A function that runs a program which sees the device on its USB."""
    root = Path(tempfile.mkdtemp(prefix="usb"))  # a socket's path has to be short
    _show(root)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(root / "ioctl" / NODE))
    listener.listen()

    def accept() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                threading.Thread(target=_Program(device, connection).serve, daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    environment = {**os.environ, "LD_PRELOAD": str(PRELOAD), "UMOCKDEV_DIR": str(root)}

    def run(*command: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            command, env=environment, text=True, timeout=60,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    try:
        yield run
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        shutil.rmtree(root)
