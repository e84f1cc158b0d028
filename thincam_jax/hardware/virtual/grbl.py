"""A virtual machine with GRBL 1.1: one axis X, on a board powered by the serial port.

When opened or unplugged, the board restarts and forgets its position, as many boards do.
"""

import re

from thincam_jax.hardware.virtual.serial_device import VirtualSerialDevice

GREETING = b"\r\nGrbl 1.1h ['$' for help]\r\n"
PULL_OFF = 1.0  # mm from the switch, after homing
LONGEST_LINE = 80  # bytes of the board's buffer
QUEUE = 15  # pending moves
_WORDS = re.compile(rb"(?:([A-Z])(-?[0-9]+(?:\.[0-9]*)?))")
_LINE = re.compile(rb"(?:[A-Z]-?[0-9]{1,6}(?:\.[0-9]{0,6})?)+")
_REALTIME = re.compile(rb"[?!~\x18]")


class VirtualGrbl(VirtualSerialDevice):
    """The machine at the end of a pseudo-terminal; see `VirtualSerialDevice`.

    Its switch is at the upper end, where GRBL counts 0; below it counts negative.
    """

    _state = "Alarm"
    _blocked = False  # after an alarm that only a reset ends
    _homing = 0  # 1: to the switch, 2: off it
    _asked = False  # for its state, while homing
    _queue: tuple[float, ...] = ()  # mm, as counted

    def _connected(self) -> None:
        self._restart()
        self._state = "Alarm"

    def _restart(self) -> None:
        if self._moving:  # a hard stop loses steps
            self._slip += 0.05
            self._brake()
            self._send(b"ALARM:%d\r\n" % (6 if self._homing else 3))
            self._state = "Alarm"
        elif self._state.startswith("Hold"):
            self._state = "Idle"
        self._homing, self._blocked, self._queue = 0, False, ()
        self._input.clear()
        self._send(GREETING)
        if self._state == "Alarm":
            self._send(b"[MSG:'$H'|'$X' to unlock]\r\n")

    def _stopped(self, stalled: bool) -> None:
        if stalled:  # the motor's alarm is wired to the limit switch's input
            self._homing, self._blocked, self._state = 0, True, "Alarm"
            self._queue = ()
            self._send(b"ALARM:1\r\n[MSG:Reset to continue]\r\n")
        elif self._homing == 1:
            self._referenced(self.motion.travel)
            self._homing = 2
            self._go(self.motion.travel - PULL_OFF)
        elif self._homing == 2:
            self._homing, self._state = 0, "Idle"
            self._answer(b"ok")
            if self._asked:
                self._report()
        elif self._queue:
            self._next()
        elif self._state == "Run":
            self._state = "Idle"

    def _receive(self, data: bytes) -> None:
        for command in _REALTIME.findall(data):
            if command == b"\x18":
                self._restart()
            elif command == b"?" and self._homing:
                self._asked = True
            elif command == b"?":
                self._report()
            elif command == b"!" and self._state in ("Idle", "Run"):
                self._brake()
                self._queue = ()
                self._state = "Hold:0"
            elif command == b"~" and self._state == "Hold:0":
                self._state = "Idle"
        for line in self._lines(_REALTIME.sub(b"", data)):
            if not self._blocked and not self._homing:
                self._obey(line.strip().upper().replace(b" ", b""))

    def _report(self) -> None:
        self._asked = False
        place = self._counted - self.motion.travel
        text = f"<{self._state}|MPos:{place:.3f},0.000,0.000|FS:0,0>"
        self._answer(text.encode("ascii"))

    def _garble(self, line: bytes) -> bytes:
        """Change a digit, or else replace a byte by an invalid one."""
        digits = [at for at, byte in enumerate(line) if 48 <= byte <= 57]
        at = self._random.choice(digits or range(len(line)))
        wrong = b"%d" % ((line[at] - 47) % 10) if digits else b"\xf1"
        return line[:at] + wrong + line[at + 1 :]

    def _obey(self, line: bytes) -> None:
        if self.faults.due("nak"):
            answer = b"error:3"
        elif line.startswith(b"$") and line != b"$G" and self.faults.due("busy"):
            answer = b"error:8"
        elif len(line) > LONGEST_LINE:
            answer = b"error:11"
        elif line.startswith(b"$"):
            answer = self._system(line)
        else:
            answer = self._move(line)
        if answer:
            self._answer(answer)

    def _system(self, line: bytes) -> bytes:
        if line == b"$G":
            self._answer(b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]")
        elif self._state not in ("Idle", "Alarm"):
            return b"error:8"
        elif line == b"$I":
            self._answer(b"[VER:1.1h.20190830:virtual]\r\n[OPT:V,15,128]")
        elif line == b"$$":
            for number, value in self._settings().items():
                self._answer(b"$%d=%b" % (number, value.encode("ascii")))
        elif line == b"$X":
            self._state = "Idle"
        elif line == b"$H":
            self._state, self._homing = "Home", 1
            self._go(self.motion.travel + self._slip)
            return b""  # the answer follows at the end
        else:
            return b"error:3"
        return b"ok"

    def _settings(self) -> dict[int, str]:
        speed, travel = f"{60 * self.motion.speed:.3f}", f"{self.motion.travel:.3f}"
        return {
            **{0: "10", 1: "25", 2: "0", 3: "0", 10: "1", 11: "0.010", 13: "0", 20: "1"},
            **{21: "1", 22: "1", 23: "0", 27: f"{PULL_OFF:.3f}", 100: "400.000"},
            **{110: speed, 120: "10.000", 130: travel},
        }

    def _move(self, line: bytes) -> bytes:
        if not line:
            return b"ok"
        if self._state == "Alarm":
            return b"error:9"
        if not _LINE.fullmatch(line):
            return b"error:2"
        words = [(letter, float(number)) for letter, number in _WORDS.findall(line)]
        place = [number for letter, number in words if letter == b"X"]
        codes = [number for letter, number in words if letter == b"G"]
        if len(place) != 1 or 53 not in codes or not {0, 1} & set(codes) or 20 in codes:
            return b"error:20"  # no other G-code is supported
        if not -self.motion.travel <= place[0] <= 0:
            self._state, self._blocked = "Alarm", True
            return b"ALARM:2\r\n[MSG:Reset to continue]"
        if len(self._queue) >= QUEUE:
            return b"error:11"
        self._queue += (place[0] + self.motion.travel,)
        if self._state == "Idle":
            self._state = "Run"
            self._next()
        return b"ok"

    def _next(self) -> None:
        first, self._queue = self._queue[0], self._queue[1:]
        self._go(first)
