"""Zaber stages with the Zaber ASCII protocol (firmware 6 and 7).

A command `/1 1 07 move abs 1000:E9` is for device 1, axis 1, has the number 7 and ends in a
checksum; its answer `@01 1 07 OK BUSY -- 0:E0` repeats the number, which pairs the two. Positions
are microsteps on the wire, millimetres here.
"""

import re
import time
from dataclasses import dataclass

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.base import Identity, NotHomed, ProtocolError, Timeout
from thincam_jax.hardware.stages.serial_link import LONGEST_LINE, SerialLink
from thincam_jax.hardware.stages.serial_stage import POLL, Report, SerialOptions, SerialStage

NOT_NOW = ("AGAIN", "STATUSBUSY")
# Warnings that mean a lost position, as does every fault; those begin with F.
LOST = {
    "WR": "it has no reference position",
    "WH": "it was not homed",
    "WL": "it met a limit switch where none should be",
    "WM": "it was displaced while it stood",
    "WS": "it stalled",
    "FS": "it stalled and stopped",
    "FQ": "its encoder fails",
    "FE": "it could not leave or find a limit switch",
}

_MESSAGE = re.compile(
    rb"([@!#])([0-9]{2}) ([0-9])(?: ([0-9]{2}))? ?"
    rb"(?:(?:(OK|RJ) )?(BUSY|IDLE) ([A-Z]{2}|--))?(?: ([ -9;-~]{0,400}))?(?::([0-9A-F]{2}))?"
)


@dataclass(frozen=True)
class ZaberMessage:
    """Message of a device: an answer "@", an alert "!" or information "#"."""

    kind: str
    device: int
    axis: int
    number: int | None  # of the answered command
    accepted: bool
    busy: bool
    warning: str  # the worst active one, "--" for none
    data: str
    checked: bool  # whether it came with a (matching) checksum


def checksum(body: bytes) -> int:
    """Longitudinal redundancy check: the byte that brings the sum of all to 0 modulo 256."""
    return -sum(body) & 0xFF


def parse_message(line: bytes) -> ZaberMessage:
    """Parse a line from a device, without its end; `ProtocolError` for an invalid one."""
    matched = _MESSAGE.fullmatch(line) if len(line) <= LONGEST_LINE else None
    if matched is None:
        raise _wrong(line, "no message of the protocol")
    kind, device, axis, number, flag, status, warning, data, check = matched.groups()
    if (kind == b"@") != (flag is not None) or (kind == b"!") and status is None:
        raise _wrong(line, "no message of the protocol")
    if check is not None and checksum(line[1 : matched.start(9) - 1]) != int(check, 16):
        raise _wrong(line, "wrong checksum")
    return ZaberMessage(
        kind=kind.decode(),
        device=int(device),
        axis=int(axis),
        number=None if number is None else int(number),
        accepted=flag == b"OK",
        busy=status == b"BUSY",
        warning=(warning or b"--").decode(),
        data=(data or b"").decode(),
        checked=check is not None,
    )


def _wrong(line: bytes, cause: str) -> ProtocolError:
    return ProtocolError("zaber", "read", f"{cause}: {line[:80]!r}",
                         "check the baud rate and the cable")  # fmt: skip


class ZaberStage(SerialStage):
    """One axis of a Zaber device, which may already be homed when it is opened."""

    _protocol = "zaber"

    @checked
    @dataclass(frozen=True)
    class Options(SerialOptions):
        """Also the stage's place in the chain, and the length of its microstep."""

        device: int = 1
        axis: int = 1
        microstep: float = 0.0001905  # mm, from the data sheet; here of an X-LSM

        def __post_init__(self) -> None:
            if not (self.microstep > 0 and self.answer_time > 0):
                raise ValueError(
                    f"microstep {self.microstep} mm, answer_time {self.answer_time} s: give "
                    "more than 0; the data sheet of the stage names its microstep"
                )

    def __init__(self, link: SerialLink, options: Options):
        super().__init__(link, options)
        self._number = 0
        self._checked = False  # until checksums are switched on
        self._doubt = False  # whether bytes of earlier answers may still come
        self._resolution = options.microstep
        self._ask("set comm.checksum 1", axis=0)  # a lasting setting, harmless to other programs
        self._checked = True
        device = self._number_of("get deviceid", axis=0)
        serial = self._number_of("get system.serial", axis=0)
        version = self._ask("get version", axis=0).data
        self.identity = Identity("Zaber", f"device {device:.0f}", f"{serial:.0f}", version)
        low, high = self._number_of("get limit.min"), self._number_of("get limit.max")
        self.limits = low * options.microstep, high * options.microstep

    @property
    def homed(self) -> bool:
        self._warnings("warnings")
        return not self._lost

    def _start_move(self, position: float) -> None:
        self._ask(f"move abs {round(position / self._options.microstep)}")

    def _halt(self) -> None:
        self._ask("stop")

    def _report(self) -> Report:
        reply = self._ask("get pos")
        return Report(reply.busy, self._value(reply) * self._options.microstep)

    def _home(self, deadline: float) -> None:
        stops = self._stops
        self._warnings("warnings clear")
        with self._lock:  # may be sent twice, but never after a stop
            if stops == self._stops:
                self._ask("home")
        while self._report().moving:
            if time.monotonic() > deadline:
                raise Timeout(self._link.name, "home", "no reference found in time",
                              "check that its way is free, and allow more time")  # fmt: skip
            time.sleep(POLL)
        self._lost = ""
        self._warnings("warnings")
        if stops != self._stops and not self._lost:
            self._lost = "its homing was stopped"
        if self._lost:
            raise NotHomed(self._link.name, "home", self._lost, "free its way and home it again")

    def _warnings(self, command: str) -> None:
        """Query all active warnings: an answer shows only the worst."""
        for warning in self._ask(command).data.split()[1:]:
            self._notice(warning)

    def _notice(self, warning: str) -> None:
        if warning in LOST or warning.startswith("F"):
            self._lost = f"{LOST.get(warning, 'it reports a fault')} ({warning})"

    def _number_of(self, command: str, axis: int | None = None) -> float:
        return self._value(self._ask(command, axis))

    def _value(self, reply: ZaberMessage) -> float:
        if re.fullmatch(r"-?[0-9]{1,12}(\.[0-9]{1,9})?", reply.data):
            return float(reply.data)
        raise ProtocolError(self._link.name, "read", f"{reply.data[:80]!r} is no number",
                            "check that axis and device are those of a stage")  # fmt: skip

    def _ask(self, command: str, axis: int | None = None) -> ZaberMessage:
        """Accepted answer to a command."""

        def refusal(reply: ZaberMessage) -> str:
            if not reply.accepted and reply.data not in NOT_NOW:
                raise ProtocolError(self._link.name, command, f"refused: {reply.data[:80]}",
                                    "check the options device and axis")  # fmt: skip
            return "" if reply.accepted else f"refused as not now: {reply.data}"

        address = self._options.axis if axis is None else axis
        return self._repeat(command, lambda: self._exchange(command, address), refusal)

    def _exchange(self, command: str, axis: int) -> ZaberMessage:
        if self._doubt:
            self._link.purge()
        self._doubt = True  # until the answer is there
        self._number = (self._number + 1) % 100
        own = (self._options.device, axis, self._number)
        body = f"{own[0]} {own[1]} {own[2]:02} {command}".encode("ascii")
        deadline = time.monotonic() + self._options.answer_time
        self._link.write(b"/%b:%02X\r\n" % (body, checksum(body)), deadline)
        while True:
            line = self._link.read_line(deadline)
            reply = parse_message(line)
            if self._checked and not reply.checked:
                raise _wrong(line, "no checksum")
            if reply.kind == "@" and (reply.device, reply.axis, reply.number) == own:
                self._notice(reply.warning)
                self._doubt = False
                return reply  # others are alerts, or late answers to earlier commands
