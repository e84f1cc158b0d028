"""Base of the stages on a serial line: nothing is sent before it is checked, and a position
counts only where the stage stands and knows where it is."""

import threading
import time
from abc import abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from thincam_jax.hardware.base import Identity, Stage
from thincam_jax.hardware.errors import (
    HardwareError,
    NotHomed,
    OutOfRange,
    ProtocolError,
    Timeout,
)
from thincam_jax.hardware.stages.serial_link import SerialLink

POLL = 0.005  # s between two questions to a stage that moves
GRACE = 0.5  # s that a stage may stand elsewhere before it starts, and after
TRIES = 3  # every command is absolute: sent twice, it does the same

Opened = TypeVar("Opened", bound="SerialStage")


@dataclass(frozen=True)
class Report:
    """Identity of a stage and its state."""

    moving: bool
    position: float  # mm


@dataclass(frozen=True)
class SerialOptions:
    """Options of a stage in a config file."""

    port: str  # "/dev/ttyUSB0", "COM3"
    baud_rate: int = 115200
    answer_time: float = 1.0  # s allowed for an answer
    wire_log: str | None = None  # file for all that is sent and received


class SerialStage(Stage):
    """A stage on a serial line. One thread may move it and another stop it."""

    _protocol: ClassVar[str]  # its name in errors
    _link: SerialLink
    _identity: Identity
    _limits: tuple[float, float]  # mm
    _resolution: float  # mm, the smallest step

    def __init__(self, link: SerialLink, options: Any):
        self._link, self._options = link, options
        self._lock = threading.RLock()  # one question and its answer
        self._stops = 0
        self._lost = ""  # why its position is not to be trusted until it is homed again

    @classmethod
    def open(cls: type[Opened], options: Any) -> Opened:
        """The stage of the driver's `Options`. It is not moved; a machine that moves is stopped."""
        link = SerialLink(cls._protocol, options.port, options.baud_rate, options.wire_log)
        try:
            return cls(link, options)
        except BaseException:
            link.close()
            raise

    @abstractmethod
    def _start_move(self, position: float) -> None:
        """Sends the stage there; returns once it has taken the command."""

    @abstractmethod
    def _home(self, deadline: float) -> None:
        """Homes the stage; returns once it stands still."""

    @abstractmethod
    def _halt(self) -> None:
        """Tells the stage to stop; it may still slow down."""

    @abstractmethod
    def _report(self) -> Report:
        """Where the stage says it is; sets `_lost` where that is not to be trusted."""

    @property
    def identity(self) -> Identity:
        return self._identity

    @property
    def limits(self) -> tuple[float, float]:
        return self._limits

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
        low, high = self._limits
        if not low <= position <= high:  # NaN, too
            raise OutOfRange(self._link.name, "move", f"{position:g} mm",
                             f"give a position from {low:g} to {high:g} mm")  # fmt: skip
        self._check_homed("move")
        stops, stood = self._stops, time.monotonic()
        deadline = stood + timeout
        with self._lock:  # it may be sent twice, but never after a stop
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

    def _check_homed(self, operation: str) -> None:
        if not self.homed:
            raise self._not_homed(operation)

    def _not_homed(self, operation: str) -> NotHomed:
        cause = self._lost or "it does not know where it is"
        return NotHomed(self._link.name, operation, cause, "home it first")
