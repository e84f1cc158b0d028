"""A stage that a person moves: it asks for each position, and takes what the micrometer reads."""

import contextlib
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.base import Identity, NotFound, OutOfRange, Stage

_QUIT = ("q", "quit")


class ManualStage(Stage):
    """A stage moved by hand, which asks on standard error and reads answers on standard input.

    Enter takes the position that was asked for, a number, mm, the one that the scale reads: it is
    the one reported and stored. q and Ctrl-C raise KeyboardInterrupt. After an interruption the
    reading of that time is offered again (`recall`).

    - `on_move`: called with each position that is read, mm.

    **Errors**: NotFound, one line, where standard input ends: answers come from a terminal, a pipe
    or a file.
    """

    by_hand = True

    @checked
    @dataclass(frozen=True)
    class Options:
        """`name`: the part that is moved. `lowest`, `highest`: ends of its scale, mm.

        - `tolerance`: largest difference, mm, of a reading from the position asked for; what is
          farther off is asked again.
        """

        name: str = "the stage"
        lowest: float = 0.0
        highest: float = 25.0
        tolerance: float = 0.5

        def __post_init__(self) -> None:
            if not self.lowest < self.highest or not self.tolerance > 0:
                raise ValueError(
                    f"lowest {self.lowest} mm, highest {self.highest} mm, tolerance "
                    f"{self.tolerance} mm: give lowest below highest, and a tolerance above 0"
                )

    def __init__(self, options: Options, on_move: Callable[[float], None] = lambda place: None):
        self._options, self._on_move = options, on_move
        self.identity = Identity("thincam_jax", "stage by hand", options.name)
        self.limits = options.lowest, options.highest
        self._stands: tuple[float, float] | None = None  # asked for, and read
        self._known: dict[float, float] = {}

    @property
    def homed(self) -> bool:
        return True  # its scale is read

    def home(self, timeout: float = 60.0) -> None:
        pass

    def recall(self, readings: Mapping[float, float]) -> None:
        self._known = dict(readings)

    def move_to(self, position: float, timeout: float = 60.0) -> float:
        low, high = self.limits
        if not low <= position <= high:  # NaN, too
            remedy = f"give a position from {low:g} to {high:g} mm, or its options lowest, highest"
            raise OutOfRange(str(self.identity), "move", f"{position:g} mm", remedy)
        if self._stands is None or self._stands[0] != position:
            offered = self._known.get(position, position)
            there = f", where it read {offered:g} mm" if offered != position else ""
            self._stands = None  # it is being moved
            self._read(
                f"Move {self._options.name} to {position:g} mm{there}, then press Enter; "
                "or type what it reads (q to stop: nothing is lost): ",
                position,
                offered,
            )
        return self.position()

    def position(self) -> float:
        if self._stands is None:
            text = f"Type where {self._options.name} stands, mm (q to stop): "
            self._read(text, None, None)
        assert self._stands is not None
        return self._stands[1]

    def stop(self) -> None:
        pass  # a person moves it

    def close(self) -> None:
        pass

    def _read(self, question: str, asked: float | None, offered: float | None) -> None:
        """Ask until the answer is a position near the one asked for."""
        reading = self._answer(question, offered)
        while fault := self._fault(reading, asked):
            reading = self._answer(f"{fault}; type it again: ", offered)
        assert isinstance(reading, float)
        self._stands = reading if asked is None else asked, reading
        self._known[self._stands[0]] = reading
        self._on_move(reading)

    def _fault(self, reading: float | str, asked: float | None) -> str:
        (low, high), near = self.limits, self._options.tolerance
        if isinstance(reading, str):
            return f"{reading[:40]!r} is no position in mm, such as 0.125"
        if not low <= reading <= high:
            return f"{reading:g} mm is off the scale, {low:g} to {high:g} mm"
        if asked is not None and abs(reading - asked) > near:
            return f"{reading:g} mm is farther than {near:g} mm from {asked:g} mm"
        return ""

    def _answer(self, question: str, offered: float | None) -> float | str:
        """The number typed, the text that is none, or what is offered for an empty line."""
        print(question, end="", file=sys.stderr, flush=True)
        with _interruptible():
            line = sys.stdin.readline() if sys.stdin is not None else ""
        if not line:
            print(file=sys.stderr)
            raise NotFound(
                str(self.identity), "move it", "nobody answers: standard input has ended",
                "begin it in a terminal, or give an answer a line"
            )  # fmt: skip
        text = line.strip()
        if text.lower() in _QUIT:
            raise KeyboardInterrupt
        if not text and offered is not None:
            return offered
        try:
            found = float(text.lower().removesuffix("mm").replace(",", "."))
        except ValueError:
            return text
        return found if math.isfinite(found) else text


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C and SIGTERM end a question at once: an acquisition's own handlers wait for a frame."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
