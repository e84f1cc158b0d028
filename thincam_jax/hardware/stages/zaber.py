"""Zaber stages, which speak the Zaber ASCII protocol (firmware 6 and 7).

A command `/1 1 07 move abs 1000:E9` is for device 1, axis 1, has the number 7 and ends in a
checksum; its answer `@01 1 07 OK BUSY -- 0:E0` carries the same number, so no answer is taken for
another's. Positions are microsteps on the wire, millimetres here.
"""

import re
import time
from dataclasses import dataclass

from thincam_jax.hardware.base import Identity
from thincam_jax.hardware.errors import Busy, NotHomed, ProtocolError, Timeout
from thincam_jax.hardware.stages.serial_link import LONGEST_LINE, SerialLink
from thincam_jax.hardware.stages.serial_stage import (
    POLL,
    TRIES,
    Report,
    SerialOptions,
    SerialStage,
)

LONGEST_REFUSAL = 2.0  # s for which "not now" is asked again
NOT_NOW = ("AGAIN", "STATUSBUSY")
# Warnings after which the position counts as lost; so does every fault, which begins with F.
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
    number: int | None  # of the command that it answers
    accepted: bool
    busy: bool
    warning: str  # the worst of those active, "--" for none
    data: str
    checked: bool  # whether it came with a checksum, which then fits


def checksum(body: bytes) -> int:
    """The longitudinal redundancy check: what makes the sum of all bytes 0 modulo 256."""
    return -sum(body) & 0xFF


def parse_message(line: bytes) -> ZaberMessage:
    """A line from a device, without its end; `ProtocolError` where it is none."""
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
    """One axis of a Zaber device. Open, it may already be homed."""

    _protocol = "zaber"

    @dataclass(frozen=True)
    class Options(SerialOptions):
        """Also where the stage is in the chain, and what its positions count."""

        device: int = 1
        axis: int = 1
        microstep: float = 0.0001905  # mm; the data sheet names it, here of an X-LSM

        def __post_init__(self) -> None:
            if not (self.microstep > 0 and self.answer_time > 0):
                raise ValueError(
                    f"microstep {self.microstep} mm, answer_time {self.answer_time} s: give "
                    "more than 0; the data sheet of the stage names its microstep"
                )

    def __init__(self, link: SerialLink, options: Options):
        super().__init__(link, options)
        self._number = 0
        self._checked = False  # until the device is told to send checksums
        self._resolution = options.microstep
        self._ask("set comm.checksum 1", axis=0)  # it keeps this; other programs do not mind
        self._checked = True
        device = self._number_of("get deviceid", axis=0)
        serial = self._number_of("get system.serial", axis=0)
        version = self._ask("get version", axis=0).data
        self._identity = Identity("Zaber", f"device {device:.0f}", f"{serial:.0f}", version)
        low, high = self._number_of("get limit.min"), self._number_of("get limit.max")
        self._limits = low * options.microstep, high * options.microstep

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
        with self._lock:  # it may be sent twice, but never after a stop
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
        """All warnings that are active: an answer shows the worst alone."""
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
        """The answer to a command, which is sent again where it was lost, spoilt or not taken."""
        end = time.monotonic() + LONGEST_REFUSAL
        tries = 0
        while True:
            try:
                with self._lock:
                    reply = self._exchange(command, self._options.axis if axis is None else axis)
            except (ProtocolError, Timeout):
                tries += 1
                if tries == TRIES:
                    raise
                self._link.purge()
                continue
            if reply.accepted:
                return reply
            if reply.data not in NOT_NOW:
                raise ProtocolError(self._link.name, command, f"refused: {reply.data[:80]}",
                                    "check the options device and axis")  # fmt: skip
            if time.monotonic() > end:
                raise Busy(self._link.name, command, f"refused as not now: {reply.data}",
                           "end what else uses the stage, then try again")  # fmt: skip
            time.sleep(POLL)

    def _exchange(self, command: str, axis: int) -> ZaberMessage:
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
                return reply  # others are alerts, or late answers to what was sent before
