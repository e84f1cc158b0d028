"""Faults of virtual devices, injected by tests or config files."""

import threading
from collections import Counter
from typing import Literal, get_args

Fault = Literal[
    "latency",  # the answer or the frame comes late, within the timeout
    "stale_frame",  # the previous frame, with its old number
    "short_frame",  # part of the payload is missing
    "dropped_frame",  # no frame comes
    "unplug",  # the device disconnects, and can be reopened
    "nak",  # the device refuses a valid command
    "busy",  # the device is not ready
    "lost_steps",  # the stage is not at its commanded position
    "wrong_checksum",  # the answer's checksum is wrong
]
FAULTS: tuple[Fault, ...] = get_args(Fault)


class Faults:
    """Pending faults of a device; thread-safe.

    `inject` adds one; the device calls `due` where the fault would occur, and plays it if that is
    True. `happened` counts the played ones.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: Counter[Fault] = Counter()
        self.happened: Counter[Fault] = Counter()

    def inject(self, fault: Fault, times: int = 1) -> None:
        """Add a fault, `times` times."""
        if fault not in FAULTS:
            raise ValueError(f"{fault!r} is no fault; give one of {', '.join(FAULTS)}")
        with self._lock:
            self._waiting[fault] += times

    def due(self, fault: Fault) -> bool:
        """Whether to play this fault now; consumes one."""
        with self._lock:
            if not self._waiting[fault]:
                return False
            self._waiting[fault] -= 1
            self.happened[fault] += 1
            return True

    def waiting(self) -> bool:
        """Whether faults are pending."""
        with self._lock:
            return self._waiting.total() > 0
