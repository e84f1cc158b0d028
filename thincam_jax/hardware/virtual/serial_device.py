"""A stage that is not there: its slide, and the pseudo-terminal at which a driver finds it.

A pseudo-terminal is a file. Its mode keeps other users out; it is reached through a folder of mode
0700 whose name nobody can guess; the driver that has opened it forbids a second opening. So no
process of another user can command the device, and none of the same user while a driver holds it.
"""

import os
import random
import secrets
import select
import shutil
import tempfile
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from thincam_jax.hardware.virtual.faults import Faults

TICK = 0.002  # s between two looks at a slide that moves
LONGEST_INPUT = 1024  # bytes kept of a line without an end
PAUSE = 0.005  # s between two looks at a device that stands

Virtual = TypeVar("Virtual", bound="VirtualSerialDevice")


@dataclass(frozen=True)
class Motion:
    """Motion of a virtual stage, and the delay of its answers where that fault is played."""

    travel: float = 50.0  # mm
    speed: float = 100.0  # mm/s
    start: float = 0.0  # mm, where it stands when it is switched on
    latency: float = 0.05  # s


class VirtualSerialDevice(ABC):
    """A device that answers at `port` from a thread of its own until it is closed.

    `true_position` is where the slide is, in mm, whatever the device believes. `on_move` is told
    it, from that thread, before the device answers that it moved or stands.
    """

    def __init__(
        self,
        motion: Motion | None = None,
        faults: Faults | None = None,
        on_move: Callable[[float], None] | None = None,
        seed: int = 0,
    ):
        self.motion, self.faults = motion or Motion(), faults or Faults()
        self.true_position = self.motion.start
        self._target = self.motion.start
        self._slip = 0.0  # mm by which the device's own count is wrong
        self._stalls = False
        self._on_move = on_move
        self._random = random.Random(seed)
        self._input = bytearray()
        self._in_use = False
        self._moved = time.monotonic()
        self._folder = Path(tempfile.gettempdir()) / f"thincam-{secrets.token_hex(16)}"
        self._folder.mkdir(mode=0o700)
        self.port = self._folder / type(self).__name__.lower()
        self._closing = threading.Event()
        self._master = -1
        self._new_terminal()
        self._tell()
        self._thread = threading.Thread(target=self._run, name=self.port.name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and removes the port; may be called twice."""
        self._closing.set()
        self._thread.join()

    def __enter__(self: Virtual) -> Virtual:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # What a device is made of.

    @abstractmethod
    def _receive(self, data: bytes) -> None:
        """Takes bytes from the driver."""

    @abstractmethod
    def _connected(self) -> None:
        """A driver has opened the terminal."""

    @abstractmethod
    def _stopped(self, stalled: bool) -> None:
        """The slide has come to a stand, by itself or because steps were lost."""

    @abstractmethod
    def _garble(self, line: bytes) -> bytes:
        """The line as it comes over a bad cable."""

    @property
    def _moving(self) -> bool:
        return self.true_position != self._target

    @property
    def _counted(self) -> float:
        """Where the device believes that it is, in mm."""
        return self.true_position + self._slip

    def _go(self, counted: float) -> None:
        """Starts towards a place as the device counts; lost steps end it half-way."""
        self._target = counted - self._slip
        self._stalls = self._moving and self.faults.due("lost_steps")
        if self._stalls:
            self._target = (self.true_position + self._target) / 2
        if not self._moving:
            self._stopped(stalled=False)

    def _brake(self) -> None:
        """Stops where it is."""
        self._target, self._stalls = self.true_position, False

    def _referenced(self, counted: float) -> None:
        """The slide stands at a place that is known: what was lost is found again."""
        self._slip = counted - self.true_position

    def _answer(self, line: bytes) -> None:
        """Sends a line, with whatever fault is due."""
        if self.faults.due("latency"):
            self._closing.wait(self.motion.latency)
            self._advance()
        if self.faults.due("wrong_checksum"):
            line = self._garble(line)
        self._send(line + b"\r\n")

    def _send(self, data: bytes) -> None:
        try:
            os.write(self._master, data)
        except OSError:
            pass  # nobody reads: a serial line loses what nobody takes

    def _lines(self, data: bytes) -> list[bytes]:
        """Whole lines so far; of a line without an end no more is kept than any command needs."""
        *lines, rest = (bytes(self._input) + data).split(b"\n")
        self._input[:] = rest[:LONGEST_INPUT]
        return [line.rstrip(b"\r") for line in lines]

    # The thread.

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                poll = select.poll()
                poll.register(self._master, select.POLLIN)
                happened = poll.poll(1e3 * (TICK if self._moving else PAUSE))
                self._advance()
                events = happened[0][1] if happened else 0
                if self.faults.due("unplug"):
                    self._new_terminal()
                elif events & select.POLLHUP and not events & select.POLLIN:  # nobody is there
                    self._in_use = False
                    self._closing.wait(TICK if self._moving else PAUSE)
                else:
                    if not self._in_use:
                        self._in_use = True
                        self._input.clear()
                        self._connected()
                    if events & select.POLLIN:
                        self._receive(os.read(self._master, LONGEST_INPUT))
        finally:
            os.close(self._master)
            shutil.rmtree(self._folder, ignore_errors=True)

    def _advance(self) -> None:
        """Moves the slide by the time that has passed."""
        now = time.monotonic()
        passed, self._moved = now - self._moved, now
        if not self._moving:
            return
        step = self.motion.speed * passed
        way = self._target - self.true_position
        at = self._target if abs(way) <= step else self.true_position + (step if way > 0 else -step)
        self.true_position = at
        self._tell()
        if not self._moving:
            if self._stalls:
                self._slip += 0.1 * self._random.choice((-1, 1))
            self._stopped(self._stalls)

    def _tell(self) -> None:
        if self._on_move is not None:
            self._on_move(self.true_position)

    def _new_terminal(self) -> None:
        """Puts a new terminal at the path, and takes the old one away."""
        old = self._master
        self._in_use = False
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave)
            os.fchmod(slave, 0o600)
            name = os.ttyname(slave)
        finally:
            os.close(slave)
        os.set_blocking(self._master, False)
        new = self.port.with_suffix(".new")
        new.symlink_to(name)
        new.replace(self.port)
        if old >= 0:  # not before: who sees that it has gone finds the new one
            os.close(old)
