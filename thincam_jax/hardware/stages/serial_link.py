"""A serial line that never hangs: every read and write has a deadline."""

import errno
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

import serial
from serial.tools import list_ports

from thincam_jax.hardware.base import (
    Busy,
    Disconnected,
    HardwareError,
    NotFound,
    PermissionDenied,
    ProtocolError,
    Timeout,
)
from thincam_jax.hardware.holder import holder

LONGEST_LINE = 512  # bytes; longer than any answer of a stage
READ_AT_ONCE = 4096  # bytes
QUIET = 0.02  # s without a byte after which the line is silent
LONGEST_PURGE = 0.5  # s

_NOT_FOUND = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ENOTDIR, errno.EISDIR, errno.ENOTTY)
_DENIED = (errno.EACCES, errno.EPERM)
_HELD = (errno.EBUSY, errno.EAGAIN)


class SerialLink:
    """Lines of text over a serial port that is opened exclusively.

    `wire_log` is a file to which every line sent or received is appended, with its time. Deadlines
    are times of `time.monotonic()`, in s. Raises `HardwareError` only: `Timeout` at a deadline,
    `Disconnected` where the port has gone, `ProtocolError` for a line above `LONGEST_LINE`.
    """

    def __init__(self, name: str, port: str, baud_rate: int, wire_log: str | None = None):
        self.name = f"{name} at {port}"
        self._buffer = bytearray()
        self._log: TextIO | None = None
        if wire_log is not None:
            try:
                Path(wire_log).parent.mkdir(parents=True, exist_ok=True)
                self._log = open(wire_log, "a", encoding="ascii", buffering=1)
            except OSError as error:
                raise PermissionDenied(self.name, "open", f"no wire log at {wire_log} ({error})",
                                       "name a file that you may write") from error  # fmt: skip
        try:
            with _translated(lambda error: _why_not_open(self.name, port, error)):
                self._serial = serial.Serial(port, baud_rate, timeout=0, exclusive=True)
                _allow_second_opening(self._serial, False)
        except BaseException:
            if self._log is not None:
                self._log.close()
            raise

    def write(self, data: bytes, deadline: float) -> None:
        """Send bytes; `Timeout` where the port does not accept them in time."""
        with _translated(lambda error: self._why_gone("write", error)):
            self._serial.write_timeout = min(max(deadline - time.monotonic(), 0.001), 60.0)
            self._serial.write(data)
        self._note(">", data)

    def read_line(self, deadline: float) -> bytes:
        """Next line, without its end; `Timeout` at the deadline, even if part of it is there."""
        while True:
            left = deadline - time.monotonic()
            if left <= 0:
                raise Timeout(self.name, "read", "no answer in time",
                              "check its power, the cable, the port and the baud rate")  # fmt: skip
            end = self._buffer.find(b"\n")
            if max(end, 0 if end >= 0 else len(self._buffer)) > LONGEST_LINE:
                self._buffer.clear()
                raise ProtocolError(self.name, "read", f"a line of more than {LONGEST_LINE} bytes",
                                    "check the baud rate and what is connected")  # fmt: skip
            if end >= 0:
                line = bytes(self._buffer[:end])
                del self._buffer[: end + 1]
                self._note("<", line)
                return line.rstrip(b"\r")
            self._buffer += self._receive(left)

    def purge(self) -> None:
        """Discard bytes until the line is silent, so that the next line is complete."""
        end = time.monotonic() + LONGEST_PURGE
        while self._receive(QUIET):
            if time.monotonic() > end:
                raise ProtocolError(self.name, "purge", "it does not stop sending",
                                    "check the baud rate and what is connected")  # fmt: skip
        self._buffer.clear()

    def close(self) -> None:
        """Release the port; never raises."""
        with suppress(HardwareError), _translated(lambda error: self._why_gone("close", error)):
            _allow_second_opening(self._serial, True)
        for file in (self._serial, self._log):
            with suppress(OSError):  # the port has gone, or the disk of the log is full
                if file is not None:
                    file.close()

    def _receive(self, seconds: float) -> bytes:
        """Bytes received, after waiting up to `seconds` for the first."""
        with _translated(lambda error: self._why_gone("read", error)):
            self._serial.timeout = seconds
            return self._serial.read(min(max(1, self._serial.in_waiting), READ_AT_ONCE))

    def _note(self, direction: str, data: bytes) -> None:
        if self._log is not None and not self._log.closed:
            with suppress(OSError):  # a full disk ends the log, not the acquisition
                self._log.write(f"{datetime.now(UTC).isoformat()} {direction} {data!r}\n")

    def _why_gone(self, operation: str, error: Exception) -> HardwareError:
        if isinstance(error, serial.SerialTimeoutException):
            return Timeout(self.name, operation, "the port takes no more bytes",
                           "check the cable and the flow control")  # fmt: skip
        return Disconnected(self.name, operation, f"the port has gone ({error})",
                            "plug it in again and open it again")  # fmt: skip


@contextmanager
def _translated(why: Callable[[Exception], HardwareError]) -> Iterator[None]:
    """Turn errors of pyserial and of the system into errors of a device."""
    try:
        yield
    # termios.error is no OSError; a port that was closed has no file descriptor: a TypeError
    except (OSError, ValueError, TypeError) as error:
        raise why(error) from error
    except Exception as error:
        if type(error).__module__ != "termios":
            raise
        raise why(error) from error


def _why_not_open(name: str, port: str, error: Exception) -> HardwareError:
    number = error.errno if isinstance(error, OSError) else None
    if number in _HELD:
        remedy = "close that program, then try again"
        return Busy(name, "open", f"{holder(port)} holds it", remedy)
    if number in _DENIED:
        return PermissionDenied(name, "open", "this user may not open it", _way_in(port))
    if number in _NOT_FOUND or (number is None and os.path.exists(port)):
        others = ", ".join(found.device for found in list_ports.comports()) or "none"
        return NotFound(name, "open", f"no serial port that works ({error})",
                        f"check the cable and the option port; ports here: {others}")  # fmt: skip
    return Disconnected(name, "open", str(error), "plug it in again and open it again")


def _way_in(port: str) -> str:
    """Advice on how to gain access to the port: its group, else a udev rule."""
    rule = 'a udev rule with SUBSYSTEM=="tty", MODE="0660", GROUP="dialout"'
    try:
        import grp

        group = grp.getgrgid(os.stat(port).st_gid).gr_name
    except (ImportError, OSError, KeyError):
        group = "dialout"
    if group == "root":
        return f"write {rule}, and: sudo usermod -aG dialout $USER, then log in again"
    return f"sudo usermod -aG {group} $USER, then log in again; or {rule}"


def _allow_second_opening(port: serial.Serial, allowed: bool) -> None:
    """Allow or forbid others to open the port; pyserial's own lock is only advisory."""
    if os.name == "posix":
        import fcntl
        import termios

        fcntl.ioctl(port.fileno(), termios.TIOCNXCL if allowed else termios.TIOCEXCL)
