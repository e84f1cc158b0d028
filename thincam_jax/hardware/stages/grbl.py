"""Stages driven by GRBL 1.1, the motion controller of many small machines.

Its "ok" means that a move is queued, not done, so its state is polled until it is Idle. Its lines
carry neither checksum nor number: a value counts once two readings agree, and after any doubt `$G`,
whose answer is unique, marks the end of the answers to earlier commands. Positions are GRBL's
machine positions, measured from the lowest of the axis.
"""

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.base import Disconnected, HardwareError, Identity, ProtocolError, Timeout
from thincam_jax.hardware.stages import serial_stage
from thincam_jax.hardware.stages.serial_link import LONGEST_LINE, SerialLink
from thincam_jax.hardware.stages.serial_stage import Answer, Report, SerialOptions, SerialStage

RESET, HOLD, ASK = b"\x18", b"!", b"?"  # real-time commands, obeyed anywhere in a line
STARTING = 5.0  # s; opening the port restarts many boards
STOPPING = 10.0  # s
MOST_LINES = 200  # of one answer
MOST_READINGS = 5  # until two agree
ROUNDING = 0.0005  # mm, half of the last digit of a position
NOT_IDLE, LOCKED = 8, 9  # numbers of errors
ALARMS = {
    1: "it met a limit switch, or its motor raised the alarm",
    2: "it was sent beyond its limits",
    3: "it was reset while it moved",
    6: "its homing was stopped",
    8: "homing could not leave the limit switch",
    9: "homing found no limit switch",
}

Kind = Literal["ok", "error", "alarm", "banner", "status", "setting", "feedback"]
_SHORT = re.compile(rb"(ok)|(error|ALARM):([0-9]{1,3})|(Grbl) ([ -~]{1,80})")
_SETTING = re.compile(rb"\$([0-9]{1,3})=(-?[0-9]{1,9}(?:\.[0-9]{1,6})?)(?: \([ -~]*\))?")
_FEEDBACK = re.compile(rb"\[[A-Za-z0-9]{1,5}:[ -~]{0,200}\]|>[ -~]{0,200}|")
_NUMBER = rb"-?[0-9]{1,7}\.[0-9]{1,4}"
_STATUS = re.compile(
    rb"<(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep)(:[0-9])?"
    rb"(?:\|MPos:(%b(?:,%b){1,5}))?(?:\|(?!MPos)[A-Za-z]{1,4}:[ -=?-{}~]{1,60}){0,8}>"
    % (_NUMBER, _NUMBER)
)


@dataclass(frozen=True)
class GrblMessage:
    """One line of GRBL; its kind decides which attributes are set."""

    kind: Kind
    number: int = 0  # of the error, the alarm or the setting
    value: float = 0.0  # of the setting
    state: str = ""  # of a status report: "Idle", "Run", "Hold:0" ...
    position: tuple[float, ...] = ()  # mm, of a status report: machine positions, if reported
    text: str = ""


def parse_line(line: bytes) -> GrblMessage:
    """Parse a line from GRBL, without its end; `ProtocolError` for an invalid one."""
    if len(line) <= LONGEST_LINE:
        if found := _SHORT.fullmatch(line):
            ok, trouble, number, _, banner = found.groups()
            if ok:
                return GrblMessage("ok")
            if trouble:
                return GrblMessage("error" if trouble == b"error" else "alarm", int(number))
            return GrblMessage("banner", text=banner.decode())
        if found := _STATUS.fullmatch(line):
            state, part, position = found.groups()
            values = tuple(map(float, position.split(b","))) if position else ()
            return GrblMessage("status", state=(state + (part or b"")).decode(), position=values)
        if found := _SETTING.fullmatch(line):
            return GrblMessage("setting", number=int(found[1]), value=float(found[2]))
        if _FEEDBACK.fullmatch(line):
            return GrblMessage("feedback", text=line.decode())
    raise ProtocolError("grbl", "read", f"no message of the protocol: {line[:80]!r}",
                        "check the baud rate and the cable")  # fmt: skip


class GrblStage(SerialStage):
    """One axis of a machine, to be homed each time it is opened: GRBL does not report it.

    GRBL counts the steps that it sends and cannot detect those that the motor misses: use a motor
    that raises an alarm at the limit switch's input, or home often.
    """

    _protocol = "grbl"

    @checked
    @dataclass(frozen=True)
    class Options(SerialOptions):
        """Also `axis`, and `speed`, mm/s; None: as fast as the machine allows."""

        axis: Literal["X", "Y", "Z"] = "X"
        speed: float | None = None

        def __post_init__(self) -> None:
            if self.axis not in ("X", "Y", "Z"):
                raise ValueError(f"axis {self.axis!r}: give X, Y or Z")
            if not (self.answer_time > 0 and (self.speed is None or self.speed > 0)):
                raise ValueError(
                    f"speed {self.speed} mm/s, answer_time {self.answer_time} s: give more than 0"
                )

    def __init__(self, link: SerialLink, options: Options):
        super().__init__(link, options)
        self._axis = "XYZ".index(options.axis)
        self._lost = "it was not homed since it was opened"
        self._homing = False
        self._doubt = True  # whether answers to earlier commands may still come
        self._lowest = 0.0
        self._restarting = True  # whether its greeting is expected
        self._start()
        version, build, counts_up = self._twice(self._build)
        settings = self._twice(self._settings)
        self.identity = Identity("GRBL", f"axis {options.axis}", build or options.port, version)
        travel = settings.get(130 + self._axis, 0.0)
        steps = settings.get(100 + self._axis, 0.0)
        plain = int(settings.get(10, 0)) & 1 and not settings.get(13) and settings.get(22)
        if not (plain and travel > 0 and steps > 0):
            cause = "it reports no machine positions in mm, or cannot home, or has no limits"
            raise self._wrong("open", cause, "send it $10=1, $13=0, $22=1 and its $100, $130 ...")
        self._resolution = 1 / steps + ROUNDING
        upwards = counts_up and int(settings.get(23, 0)) >> self._axis & 1
        self._lowest = 0.0 if upwards else -travel
        self.limits = 0.0, travel

    @property
    def homed(self) -> bool:
        self._report()
        return not self._lost

    def _start_move(self, position: float) -> None:
        speed = self._options.speed
        how = "G0" if speed is None else f"G1F{60 * speed:.1f}"
        self._ask(f"G21G90G53{how}{self._options.axis}{position + self._lowest:.3f}")

    def _halt(self) -> None:
        now = time.monotonic()
        if self._homing:  # the homing thread holds the lock, and reads the alarm
            self._restarting = True
            self._link.write(RESET, now + self._options.answer_time)
            return
        with self._lock:
            self._link.write(HOLD, now + self._options.answer_time)
            while _moves(state := self._status().state):
                if time.monotonic() > now + STOPPING:
                    raise Timeout(self._link.name, "stop", "it still moves", "switch it off")
                time.sleep(serial_stage.POLL)
            if state not in ("Idle", "Alarm"):
                self._reset()

    def _home(self, deadline: float) -> None:
        with self._lock:
            self._report()
            if self._status().state == "Alarm":  # it may obey nothing else
                self._reset()
            self._lost = "its homing did not end"
            self._homing = True
            try:
                self._ask("$H", deadline)
            except HardwareError as error:
                if isinstance(error, Timeout) or self._restarting:
                    self._reset()
                raise
            finally:
                self._homing = False
            self._lost = ""
            self._report()
            if self._lost:
                raise self._not_homed("home")

    def _report(self) -> Report:
        message = self._twice(self._status, "position", lambda m: _moves(m.state))
        if message.state == "Alarm":
            self._lost = self._lost or "it stands in alarm"
        if len(message.position) <= self._axis:
            raise self._wrong("position", "no machine position", "send it $10=1")
        place = round(message.position[self._axis] - self._lowest, 4)
        return Report(_moves(message.state), place)

    def _start(self) -> None:
        end = time.monotonic() + STARTING
        while True:
            try:
                state = self._status().state
                break
            except (Timeout, ProtocolError):
                if time.monotonic() > end:
                    raise
        self._restarting = False
        if state not in ("Idle", "Alarm"):
            self._halt()

    def _settings(self) -> dict[int, float]:
        return {m.number: m.value for m in self._ask("$$") if m.kind == "setting"}

    def _build(self) -> tuple[str, str, bool]:
        """Version, the name given by its owner, and whether 0 is at the homing switch."""
        text = "\n".join(message.text for message in self._ask("$I"))
        found = re.search(r"\[VER:([^:\]]*):(.*)\]", text)
        options = re.search(r"\[OPT:([^,\]]*)", text)
        if not found:
            raise self._wrong("open", "it does not name its version", "it has to be GRBL 1.1")
        return found[1], found[2], bool(options and "Z" in options[1])

    def _twice(
        self,
        read: Callable[[], Answer],
        operation: str = "read",
        once: Callable[[Answer], bool] = lambda value: False,
    ) -> Answer:
        """Value on which two readings agree; where `once` is true of it, one is enough."""
        value = read()
        for _ in range(MOST_READINGS):
            if once(value):
                return value
            before, value = value, read()
            if value == before:
                return value
        raise self._wrong(operation, "it says something else each time", "check the cable")

    def _ask(self, command: str, deadline: float | None = None) -> list[GrblMessage]:
        """Lines of the answer to a command."""

        def attempt() -> list[GrblMessage]:
            until = deadline or time.monotonic() + self._options.answer_time
            if self._doubt:
                self._resynchronise()
            self._doubt = True  # until the answer is complete
            answer = self._exchange(command, until)
            self._doubt = False
            return answer

        def refusal(answer: list[GrblMessage]) -> str:
            last = answer[-1]
            if last.kind == "ok":
                return ""
            if last.number == LOCKED:
                self._lost = self._lost or "it is locked until it is homed"
                raise self._not_homed(command)
            if last.number != NOT_IDLE:
                raise self._wrong(command, f"refused: error {last.number}", "see GRBL's list")
            return "it is not idle"

        return self._repeat(command, attempt, refusal, deadline or math.inf)

    def _exchange(self, command: str, deadline: float) -> list[GrblMessage]:
        self._link.write(command.encode("ascii") + b"\n", deadline)
        answer: list[GrblMessage] = []
        while len(answer) < MOST_LINES:
            message = self._read(deadline)
            if message.kind in ("alarm", "banner"):
                raise self._not_homed(command)
            answer.append(message)
            if message.kind in ("ok", "error"):
                return answer
        raise self._wrong(command, f"more than {MOST_LINES} lines", "check what is connected")

    def _resynchronise(self) -> None:
        """Skip the answers to earlier commands: `$G` is answered last, in every state."""
        self._link.purge()
        deadline = time.monotonic() + self._options.answer_time
        self._link.write(b"\n$G\n", deadline)
        while not self._read(deadline).text.startswith("[GC:"):
            pass
        while self._read(deadline).kind != "ok":
            pass

    def _status(self) -> GrblMessage:
        for left in reversed(range(serial_stage.TRIES)):
            try:
                with self._lock:
                    deadline = time.monotonic() + self._options.answer_time
                    self._link.write(ASK, deadline)
                    while (message := self._read(deadline)).kind != "status":
                        pass
                    return message
            except (ProtocolError, Timeout):
                self._doubt = True
                if not left:
                    raise
                self._link.purge()
        raise AssertionError

    def _reset(self) -> None:
        """Restart GRBL, which keeps its position unless it moved."""
        self._restarting, self._doubt = True, True
        try:
            deadline = time.monotonic() + self._options.answer_time
            self._link.write(RESET, deadline)
            while self._read(deadline).kind != "banner":
                pass
        except (ProtocolError, Timeout):
            pass  # its state shows whether it restarted
        finally:
            self._link.purge()
            self._restarting = False

    def _read(self, deadline: float) -> GrblMessage:
        message = parse_line(self._link.read_line(deadline))
        if message.kind == "alarm":
            self._lost = ALARMS.get(message.number, "alarm") + f" (alarm {message.number})"
        if message.kind == "banner" and not self._restarting:
            self._lost = "it was reset"
            raise Disconnected(self._link.name, "read", "it was reset and lost its position",
                               "open it again and home it")  # fmt: skip
        return message

    def _wrong(self, operation: str, cause: str, remedy: str) -> ProtocolError:
        return ProtocolError(self._link.name, operation, cause, remedy)


def _moves(state: str) -> bool:
    return state in ("Run", "Jog", "Home", "Hold:1", "Door:2", "Door:3")
