"""A line of progress: the work of a long call, its time, and the time left at most."""

import contextlib
import contextvars
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

# Seconds until the first line, between two that are seen, and between two of a log.
_PATIENCE, _OFTEN, _SELDOM = 1.0, 0.5, 10.0
_FIRST = "compiling, if this is the first of its size"

_is_watched = contextvars.ContextVar("is_watched", default=False)
_listener = contextvars.ContextVar[Callable[[str], None] | None]("listener", default=None)


@contextlib.contextmanager
def heard(listener: Callable[[str], None]) -> Iterator[None]:
    """Call a function with each step or word of watched calls, which write no line then."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextlib.contextmanager
def watched(what: str) -> Iterator[Callable[..., None]]:
    """Show `what` goes on while it does; also a decorator.

    Yields a function of the step done and of all steps; words of what is known so far are shown
    in their place. Nothing is shown of what takes less than a second, or within another watched
    call. At a terminal the line is written to stderr, in a notebook below its cell, and goes at the
    end; elsewhere it is logged every ten seconds, as information. THINCAM_PROGRESS=off in the
    environment ends it.
    """
    if (hear := _listener.get()) is not None:
        yield lambda step, most, said="": hear(said or f"step {step} of at most {most}")
        return
    if _is_watched.get() or os.environ.get("THINCAM_PROGRESS") == "off":
        yield lambda step, most, said="": None
        return
    line, token = _Line(what), _is_watched.set(True)
    try:
        with repeating(line.say, _PATIENCE if line.is_live else _SELDOM):
            yield line.tell
    finally:
        _is_watched.reset(token)
        line.show("")


@contextlib.contextmanager
def repeating(say: Callable[[], float], pause: float) -> Iterator[None]:
    """Call a function in a thread after a pause, s, and again after each pause that it returns."""
    over = threading.Event()

    def repeat() -> None:
        wait = pause
        while not over.wait(wait):
            wait = say()

    speaker = threading.Thread(target=repeat, daemon=True)
    speaker.start()
    try:
        yield
    finally:
        over.set()
        speaker.join()


class _Line:
    """The line of one call."""

    def __init__(self, what: str):
        self.what, self.began = what, time.monotonic()
        self.first: tuple[int, float] | None = None
        self.now, self.said = (0, 0), ""
        self.stream, self.width = sys.stderr, 0
        self.output = _notebook_output()
        self.is_live = self.stream.isatty() or self.output is not None

    def tell(self, step: int, most: int, said: str = "") -> None:
        self.now, self.said = (step, most), said
        self.first = self.first or (step, time.monotonic())

    def say(self) -> float:
        """Show or log the line; seconds until the next one."""
        if self.is_live:
            self.show(str(self))
            return _OFTEN
        logging.getLogger(__name__).info("%s", self)
        return _SELDOM

    def show(self, text: str) -> None:
        """Write the text over the one before; nothing over nothing."""
        if not text and not self.width:
            return
        if self.output is not None:
            show = self.output.update if self.width else self.output.display
            show({"text/plain": text}, raw=True)
        else:
            line = "\r" + text.ljust(self.width) + ("" if text else "\r")
            with contextlib.suppress(OSError, ValueError):  # of a stream that was closed
                self.stream.write(line)
                self.stream.flush()
        self.width = len(text)

    def __str__(self) -> str:
        spent = f"{self.what}, {time.monotonic() - self.began:.0f} s"
        if self.said:
            return f"{spent}: {self.said}"
        if self.first is None:
            return f"{spent}: {_FIRST}"
        (start, since), (step, most) = self.first, self.now
        text = f"{spent}: step {step} of at most {most}"
        if step == start:
            return text
        left = (time.monotonic() - since) / (step - start) * (most - step)
        return f"{text}, at most {left:.0f} s left"


def _notebook_output() -> Any:
    """An output below the cell, which can be written again; None where there is no notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return sys.modules["IPython"].display.DisplayHandle() if hasattr(shell, "kernel") else None
