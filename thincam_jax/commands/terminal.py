"""Exit codes, messages of errors, and progress bars of all commands.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

import _thread
import contextlib
import functools
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from thincam_jax._core.progress import heard, repeating
from thincam_jax._core.text import escaped

if TYPE_CHECKING:
    import rich.progress

    from thincam_jax._core.table import Table


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


WRONG_INPUT = 2
# What a command prints, by its options `--json` and `--quiet`.
output: Literal["text", "json", "nothing"] = "text"
_MOST_LINES, _HALF = 10, 500  # of an error; characters of each half of a line that is cut

ConfigFile = Annotated[
    Path, typer.Argument(help="Experiment file (YAML); 'thincam init' writes one.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Change a value of the file: a.b=value; entries of lists by number, from 0."
    ),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Check everything and list the work, without doing it.")
]


@contextlib.contextmanager
def reported(interrupted: Callable[[], str]) -> Iterator[None]:
    """Report user errors in one line, and Ctrl-C by the text that `interrupted` gives.

    Anything else is a defect and keeps its traceback. Python's warnings take a line each, once.
    """
    from thincam_jax._core.files import MeasurementError
    from thincam_jax._core.jax_settings import cannot_start
    from thincam_jax.commands.config_file import ConfigError

    try:
        with warnings.catch_warnings():
            once = functools.cache(lambda text: warn([text]))
            warnings.showwarning = lambda message, *_, **__: once(str(message))
            if fault := cannot_start():
                raise ConfigError(fault)
            yield
    except KeyboardInterrupt:
        tell(interrupted())
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        mended = (ConfigError, MeasurementError, OSError, MemoryError)
        room = (getattr(error, "name", None) or "") if isinstance(error, ImportError) else ""
        if room.startswith("thincam_jax."):
            error = ConfigError(f"this needs {room}, which this installation has not")
        if not isinstance(error, mended) and not _no_memory(error):
            raise
        tell(in_a_line(error))
        raise typer.Exit(WRONG_INPUT) from None


def _no_memory(error: BaseException) -> bool:
    """Whether Python or XLA ran out of memory and says nothing of use."""
    return str(error).startswith("RESOURCE_EXHAUSTED") or (
        isinstance(error, MemoryError) and not str(error)
    )


def warn(texts: list[str]) -> None:
    """Each in a line on standard error."""
    if texts:
        tell("\n".join(f"warning: {text}" for text in texts))


def in_a_line(error: BaseException) -> str:
    """Message of an error for users; `name='value'`, an argument in Python, as an option."""
    if _no_memory(error):
        return "out of memory; give fewer pixels (a larger --downsample or pitch) or close programs"
    return re.sub(r"`(\w+)(?:='(\w+)')?`", _as_option, str(error))


def _as_option(argument: re.Match[str]) -> str:
    name, value = argument.groups()
    return " ".join(filter(None, (f"--{name.replace('_', '-')}", value)))


def say(text: str) -> None:
    """Lines on standard output; as all that is printed, without the control characters of files."""
    if output == "text":
        print(escaped(text))


def say_result(name: str, value: Any, text: str = "") -> None:
    """Print a result as `name: value`, or the text; with `--json` as an object in a line."""
    if output == "json":
        import json

        print(json.dumps({name: value}, default=str))
    say(text or f"{name}: {value}")


def tell(text: str) -> None:
    """Lines on standard error, without markup: the first ones, each cut in its middle if long."""
    lines = escaped(text).split("\n")
    if (more := len(lines) - _MOST_LINES) > 0:
        lines[_MOST_LINES:] = [f"and {more:,} more"]
    for line in lines:
        cut = line if len(line) <= 2 * _HALF else f"{line[:_HALF]} … {line[-_HALF:]}"
        print(f"thincam: {cut}", file=sys.stderr)


def show(table: "Table") -> None:
    """Print a table; its cells are set to the right but for the first of each row."""
    if output == "json":
        say_result("table", {"headings": table.headings, "rows": table.rows})
    if output != "text":
        return
    import rich
    from rich.table import Table as Lines
    from rich.text import Text

    rows, title = table.texts(), Text(escaped(table.title)) if table.title else None
    several = any("\n" in cell for row in rows for cell in row)
    shown = Lines(title=title, title_justify="left", show_lines=several)
    for column, heading in enumerate(table.headings):
        left = not column or column in table.words
        shown.add_column(Text(escaped(heading)), justify="left" if left else "right")
    for row in rows:
        shown.add_row(*(Text(escaped(cell)) for cell in row))
    rich.print(shown)


@contextlib.contextmanager
def progress_bar(*more: str) -> "Iterator[rich.progress.Progress]":
    """Progress bar with a count and the times; `more`: templates, "{task.fields[objective]}".

    Hidden until it is started: before, all may be refused. What is done under it has something to
    keep when it is interrupted.
    """
    from rich import progress

    class Escaped(progress.TextColumn):
        def render(self, task: Any) -> Any:
            text = super().render(task)
            text.plain = escaped(text.plain)
            return text

    bar = progress.Progress(
        Escaped("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        *(Escaped(template, markup=False) for template in more),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
        disable=output != "text",
    )
    with interruptible():
        try:
            yield bar
        finally:
            if bar.live.is_started:
                bar.stop()


@contextlib.contextmanager
def counted(name: str) -> Iterator[Callable[[str, int], None]]:
    """A progress bar; what it yields is called at each step, with its text and their number.

    Words of long calls stand behind the text of their step.
    """
    with progress_bar() as bar, lines_in_a_log(bar):
        task, now = bar.add_task(name, total=None), name

        def begun(text: str, total: int) -> None:
            nonlocal now
            now = text
            bar.update(task, advance=1, total=total, description=text)
            bar.start()

        with heard(lambda words: bar.update(task, description=f"{now}, {words}")):
            yield begun


@contextlib.contextmanager
def lines_in_a_log(bar: "rich.progress.Progress") -> Iterator[None]:
    """A line every ten seconds on standard error where a bar cannot move, as in a file."""

    def say_all() -> float:
        for task in bar.tasks:
            tell(
                f"{task.description} ({task.completed:g} of {task.total or 0:g}), "
                f"{task.elapsed or 0:.0f} s"
            )
        return 10.0

    is_still = not bar.disable and not bar.console.is_terminal
    with repeating(say_all, 10.0) if is_still else contextlib.nullcontext():
        yield
