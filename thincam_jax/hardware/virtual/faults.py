"""Faults on demand: what a virtual device does wrong, when a test or a config file asks for it."""

import threading
from collections import Counter
from typing import Literal, get_args

Fault = Literal[
    "latency",  # the answer or the frame comes late, within the time allowed
    "stale_frame",  # the frame before, with its old number
    "short_frame",  # part of the payload is missing
    "dropped_frame",  # no frame comes
    "unplug",  # the device goes, and can be opened again
    "nak",  # the device refuses a command that it understood
    "busy",  # the device says that it is not ready
    "lost_steps",  # the stage stands elsewhere than it says it should
    "wrong_checksum",  # the answer's checksum does not fit
]
FAULTS: tuple[Fault, ...] = get_args(Fault)


class Faults:
    """Faults that wait to happen; safe to use from several threads.

    `inject` orders one; the device asks `due` at the point where the fault would show, and plays it
    if the answer is True. `happened` counts what was played.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: Counter[Fault] = Counter()
        self.happened: Counter[Fault] = Counter()

    def inject(self, fault: Fault, times: int = 1) -> None:
        """Orders a fault, as often as that."""
        if fault not in FAULTS:
            raise ValueError(f"{fault!r} is no fault; give one of {', '.join(FAULTS)}")
        with self._lock:
            self._waiting[fault] += times

    def due(self, fault: Fault) -> bool:
        """Whether this fault has to be played now; one that was ordered is used up."""
        with self._lock:
            if not self._waiting[fault]:
                return False
            self._waiting[fault] -= 1
            self.happened[fault] += 1
            return True

    def waiting(self) -> bool:
        """Whether one has been ordered and not yet played."""
        with self._lock:
            return self._waiting.total() > 0
