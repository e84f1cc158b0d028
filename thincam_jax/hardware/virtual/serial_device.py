"""A virtual serial stage: its slide, and its pseudo-terminal.

The mode of the pseudo-terminal excludes other users; its path is in a folder of mode 0700 with an
unguessable name; the driver opens it exclusively. So no process of another user can command the
device, and none of the same user while a driver holds it.
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

from thincam_jax.hardware.virtual.devices import TRAVEL, Faults

TICK = 0.002  # s between two updates of a moving slide
LONGEST_INPUT = 1024  # bytes kept of an unfinished line
PAUSE = 0.005  # s between two polls of a device at rest

Virtual = TypeVar("Virtual", bound="VirtualSerialDevice")


@dataclass(frozen=True)
class Motion:
    """Motion of a virtual stage, and the delay of its answers with the fault "latency"."""

    travel: float = TRAVEL  # mm
    speed: float = 100.0  # mm/s
    start: float = 0.0  # mm, position at power-on
    latency: float = 0.05  # s


class VirtualSerialDevice(ABC):
    """A device that answers at `port` from its own thread until it is closed.

    `true_position` is the slide's actual position in mm, whatever the device believes. `on_move`
    receives it, in that thread, before the device answers that it moves or rests.
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
        self._slip = 0.0  # mm, error of the device's own count
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
        self._report_position()
        self._thread = threading.Thread(target=self._run, name=self.port.name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and remove the port; may be called twice."""
        self._closing.set()
        self._thread.join()

    def __enter__(self: Virtual) -> Virtual:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def _receive(self, data: bytes) -> None:
        """Receive bytes from the driver."""

    def _connected(self) -> None:  # noqa: B027
        """React to a driver that has opened the terminal."""

    @abstractmethod
    def _stopped(self, stalled: bool) -> None:
        """React to the end of a move, or to a stall that lost steps."""

    @abstractmethod
    def _garble(self, line: bytes) -> bytes:
        """Corrupt a line as a bad cable does."""

    @property
    def _moving(self) -> bool:
        return self.true_position != self._target

    @property
    def _counted(self) -> float:
        """Position in mm by the device's own count."""
        return self.true_position + self._slip

    def _go(self, counted: float) -> None:
        """Start a move to a counted position; lost steps end it half-way."""
        self._target = counted - self._slip
        self._stalls = self._moving and self.faults.due("lost_steps")
        if self._stalls:
            self._target = (self.true_position + self._target) / 2
        if not self._moving:
            self._stopped(stalled=False)

    def _brake(self) -> None:
        """Stop at once."""
        self._target, self._stalls = self.true_position, False

    def _referenced(self, counted: float) -> None:
        """Correct the count at a reference position."""
        self._slip = counted - self.true_position

    def _answer(self, line: bytes) -> None:
        """Send a line, with any fault that is due."""
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
            pass  # nobody reads, so the bytes are lost

    def _lines(self, data: bytes) -> list[bytes]:
        """Complete lines so far; of an unfinished one only the longest command's length is kept."""
        *lines, rest = (bytes(self._input) + data).split(b"\n")
        self._input[:] = rest[:LONGEST_INPUT]
        return [line.rstrip(b"\r") for line in lines]

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
                elif events & select.POLLHUP and not events & select.POLLIN:  # no driver
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
        """Move the slide for the time elapsed."""
        now = time.monotonic()
        passed, self._moved = now - self._moved, now
        if not self._moving:
            return
        step = self.motion.speed * passed
        way = self._target - self.true_position
        at = self._target if abs(way) <= step else self.true_position + (step if way > 0 else -step)
        self.true_position = at
        self._report_position()
        if not self._moving:
            if self._stalls:
                self._slip += 0.1 * self._random.choice((-1, 1))
            self._stopped(self._stalls)

    def _report_position(self) -> None:
        if self._on_move is not None:
            self._on_move(self.true_position)

    def _new_terminal(self) -> None:
        """Put a new terminal at the path and remove the old one."""
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
        if old >= 0:  # afterwards, so that its user finds the new one
            os.close(old)
