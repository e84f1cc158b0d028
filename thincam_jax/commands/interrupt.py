"""Ctrl-C: it ends the command in one line, and reaches work that has something to keep."""

import _thread
import contextlib
import os
import signal
import sys
from collections.abc import Iterator

INTERRUPTED = 130  # the shells' exit code after Ctrl-C


def end_on_interrupt() -> None:
    """Let Ctrl-C end the process in one line, from now on."""
    signal.signal(signal.SIGINT, leave)
    sys.unraisablehook = _again


def leave(*_: object) -> None:
    """Leave at once: an exception would meet imports and libraries not ready for one."""
    os.write(2, b"thincam: interrupted\n")
    os._exit(INTERRUPTED)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Work that has something to keep: Ctrl-C is a KeyboardInterrupt in it."""
    before = signal.getsignal(signal.SIGINT)
    if before is not leave:  # another program's
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _again(lost: "sys.UnraisableHookArgs") -> None:
    """A KeyboardInterrupt that a callback could not pass on, as XLA's at a garbage collection."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    import threading

    # To the main thread, which may be waiting in the system.
    if hasattr(signal, "pthread_kill"):
        again = signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)
    else:  # Windows
        again = _thread.interrupt_main, ()
    threading.Timer(0.05, *again).start()
