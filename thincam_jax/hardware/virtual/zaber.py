"""A virtual Zaber stage: firmware 7, one axis with an encoder, with its own power supply.

Unplugged from the computer it keeps its position and finishes its move.
"""

import re
from dataclasses import dataclass

from thincam_jax.hardware.stages.zaber import checksum
from thincam_jax.hardware.virtual.serial_device import VirtualSerialDevice

MICROSTEP = 0.0001905  # mm
_COMMAND = re.compile(
    rb"/(?:([0-9]{1,2})(?: ([0-9])(?: ([0-9]{1,2}))?)?)? ?([ -9;-~]{0,80}?)(?::([0-9A-F]{2}))?"
)


@dataclass(frozen=True)
class _Command:
    device: int
    axis: int
    number: bytes  # as received, b"" for none
    words: tuple[bytes, ...]


def parse_command(line: bytes) -> _Command | None:
    """Parse a line from a driver; None for a wrong format or checksum, which a device ignores."""
    matched = _COMMAND.fullmatch(line)
    if matched is None:
        return None
    device, axis, number, words, check = matched.groups()
    if check is not None and checksum(line[1 : matched.start(5) - 1]) != int(check, 16):
        return None
    return _Command(int(device or 0), int(axis or 0), number or b"", tuple((words or b"").split()))


class VirtualZaber(VirtualSerialDevice):
    """A device with the address 1 at the end of a pseudo-terminal; see `VirtualSerialDevice`."""

    _flags: tuple[str, ...] = ("WR",)
    _homing = False
    _sends_checksums = False

    def _stopped(self, stalled: bool) -> None:
        if stalled:
            self._homing = False
            self._flags = ("FS",)
        elif self._homing:
            self._homing = False
            self._referenced(0.0)
            self._flags = ()

    def _receive(self, data: bytes) -> None:
        for line in self._lines(data):
            command = parse_command(line[max(line.rfind(b"/"), 0) :])  # the last start of a command
            if command is not None and command.device in (0, 1) and command.axis in (0, 1):
                self._obey(command)

    def _obey(self, command: _Command) -> None:
        if self.faults.due("nak"):
            accepted, data = False, "BADCOMMAND"
        elif self.faults.due("busy"):
            accepted, data = False, "STATUSBUSY"
        else:
            accepted, data = self._result(command.words)
        number = b" %02d" % int(command.number) if command.number else b""
        flag = self._flags[0] if self._flags else "--"
        state = "BUSY" if self._moving else "IDLE"
        head = b"01 %d%b %b " % (command.axis, number, b"OK" if accepted else b"RJ")
        body = head + f"{state} {flag} {data}".encode("ascii")
        if self._sends_checksums:
            body += b":%02X" % checksum(body)
        self._answer(b"@" + body)

    def _garble(self, line: bytes) -> bytes:
        """Flip one bit."""
        at = self._random.randrange(len(line))
        return line[:at] + bytes([line[at] ^ (1 << self._random.randrange(7))]) + line[at + 1 :]

    def _result(self, words: tuple[bytes, ...]) -> tuple[bool, str]:
        """Whether the command is accepted, and the answer's data."""
        match words:
            case ():
                return True, "0"
            case (b"get", setting):
                value = self._setting(setting)
                return value is not None, value or "BADCOMMAND"
            case (b"set", b"comm.checksum", (b"0" | b"1") as value):
                self._sends_checksums = value == b"1"
            case (b"warnings", *clear) if clear in ([], [b"clear"]):
                listed = " ".join((f"{len(self._flags):02}", *self._flags))
                if clear:  # persistent ones stay
                    self._flags = tuple("WR" if flag == "FS" else flag for flag in self._flags)
                return True, listed
            case (b"home",):
                self._homing = True
                self._go(self._slip)  # to the switch at 0 mm, whatever its count
            case (b"stop",):
                if self._homing:
                    self._homing, self._flags = False, ("WR",)
                self._brake()
            case (b"move", b"abs", number) if re.fullmatch(rb"-?[0-9]{1,9}", number):
                if "WR" in self._flags:
                    return False, "BADCOMMAND"
                if not 0 <= int(number) <= self._steps(self.motion.travel):
                    return False, "BADDATA"
                self._homing = False
                self._go(int(number) * MICROSTEP)
            case _:
                return False, "BADCOMMAND"
        return True, "0"

    def _setting(self, name: bytes) -> str | None:
        values = {
            b"pos": self._steps(self._counted),
            b"limit.min": 0,
            b"limit.max": self._steps(self.motion.travel),
            b"deviceid": 50081,
            b"system.serial": 12345,
            b"system.access": 1,
            b"system.axiscount": 1,
            b"version": "7.38",
            b"comm.checksum": int(self._sends_checksums),
        }
        return str(values[name]) if name in values else None

    @staticmethod
    def _steps(position: float) -> int:
        return round(position / MICROSTEP)
