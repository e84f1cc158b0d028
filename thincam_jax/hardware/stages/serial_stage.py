"""Base of the serial stages: commands are checked before they are sent, and a position is
reported only of a homed stage at rest."""

import math
import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from thincam_jax._core.arguments import checked
from thincam_jax.hardware import base
from thincam_jax.hardware.base import HardwareError, NotHomed, ProtocolError, Stage, Timeout
from thincam_jax.hardware.stages.serial_link import SerialLink

POLL = 0.005  # s between two queries of a moving stage
GRACE = 0.5  # s that a stage may rest elsewhere before it starts, and after
TRIES = 3  # every command is absolute, so that repeating it is safe
LONGEST_REFUSAL = 2.0  # s for which a "not now" is retried

Answer = TypeVar("Answer")
Opened = TypeVar("Opened", bound="SerialStage")


@dataclass(frozen=True)
class Report:
    """State that a stage reports."""

    moving: bool
    position: float  # mm


@checked
@dataclass(frozen=True)
class SerialOptions:
    """Options of a stage in a config file."""

    port: str  # "/dev/ttyUSB0", "COM3"
    baud_rate: int = 115200
    answer_time: float = 1.0  # s allowed for an answer
    wire_log: str | None = None  # file that logs every line sent and received


class SerialStage(Stage):
    """A stage on a serial line. One thread may move it and another stop it."""

    _protocol: ClassVar[str]  # name in errors
    _link: SerialLink
    _resolution: float  # mm, the smallest step

    def __init__(self, link: SerialLink, options: Any):
        self._link, self._options = link, options
        self._lock = threading.RLock()  # held for one query and its answer
        self._stops = 0
        self._lost = ""  # why the position cannot be trusted before homing

    @classmethod
    def open(cls: type[Opened], options: Any) -> Opened:
        """Open the stage without moving it; a moving machine is stopped."""
        link = SerialLink(cls._protocol, options.port, options.baud_rate, options.wire_log)
        try:
            return cls(link, options)
        except BaseException:
            link.close()
            raise

    @abstractmethod
    def _start_move(self, position: float) -> None:
        """Start a move; returns once the command is accepted."""

    @abstractmethod
    def _home(self, deadline: float) -> None:
        """Home the stage; returns once it is at rest."""

    @abstractmethod
    def _halt(self) -> None:
        """Command a stop; the stage may still be slowing down."""

    @abstractmethod
    def _report(self) -> Report:
        """Query the state; sets `_lost` where the position cannot be trusted."""

    def close(self) -> None:
        with suppress(HardwareError):
            if self._report().moving:
                self.stop()
        self._link.close()

    def home(self, timeout: float = 60.0) -> None:
        try:
            self._home(time.monotonic() + timeout)
        except Timeout:
            with suppress(HardwareError):
                self.stop()
            raise
        self._lost = ""

    def move_to(self, position: float, timeout: float = 60.0) -> float:
        low, high = self.limits
        if not low <= position <= high:  # NaN, too
            remedy = f"give a position from {low:g} to {high:g} mm"
            raise base.OutOfRange(self._link.name, "move", f"{position:g} mm", remedy)
        self._check_homed("move")
        stops, stood = self._stops, time.monotonic()
        deadline = stood + timeout
        with self._lock:  # may be sent twice, but never after a stop
            if stops == self._stops:
                self._start_move(position)
        while True:
            report, now = self._report(), time.monotonic()
            if self._lost:
                raise self._not_homed("move")
            arrived = abs(report.position - position) <= self._resolution
            if not report.moving and (arrived or stops != self._stops):
                return report.position
            if report.moving:
                stood = now
            elif now > stood + GRACE:
                cause = f"it stands at {report.position:g} mm instead of {position:g} mm"
                raise ProtocolError(self._link.name, "move", cause,
                                    "see what else moves or stops it")  # fmt: skip
            if now > deadline:
                with suppress(HardwareError):
                    self.stop()
                raise Timeout(self._link.name, "move", f"not there within {timeout:g} s",
                              "allow more time, or a higher speed")  # fmt: skip
            time.sleep(POLL)

    def position(self) -> float:
        report = self._report()
        self._check_homed("position")
        return report.position

    def stop(self) -> None:
        self._stops += 1
        self._halt()
        deadline = time.monotonic() + 10.0
        while self._report().moving:
            if time.monotonic() > deadline:
                raise Timeout(self._link.name, "stop", "it still moves", "switch its power off")
            time.sleep(POLL)

    def _repeat(
        self,
        command: str,
        attempt: Callable[[], Answer],
        refusal: Callable[[Answer], str],
        deadline: float = math.inf,
    ) -> Answer:
        """Answer to a command, sent again where the answer was lost, corrupted or "not now".

        `refusal` says why an answer is "not now", "" for accepted, and raises for other refusals.
        """
        end, tries = time.monotonic() + LONGEST_REFUSAL, 0
        while True:
            try:
                with self._lock:
                    answer = attempt()
            except (ProtocolError, Timeout):
                tries += 1
                if tries == TRIES or time.monotonic() > deadline:
                    raise
                continue
            cause = refusal(answer)
            if not cause:
                return answer
            if time.monotonic() > end:
                remedy = "end what else uses the stage, then try again"
                raise base.Busy(self._link.name, command, cause, remedy)
            time.sleep(POLL)

    def _check_homed(self, operation: str) -> None:
        if not self.homed:
            raise self._not_homed(operation)

    def _not_homed(self, operation: str) -> NotHomed:
        cause = self._lost or "it does not know where it is"
        return NotHomed(self._link.name, operation, cause, "home it first")
