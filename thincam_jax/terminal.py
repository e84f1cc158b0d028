"""What the commands share: consoles, exit codes, and how an error is told."""

from typing import NoReturn

import rich.console
import rich.progress
import typer

console = rich.console.Console()
errors = rich.console.Console(stderr=True)

WRONG_INPUT = 2
INTERRUPTED = 130  # the shells' exit code after Ctrl-C


def tell(text: str) -> None:
    """Lines on standard error, whole and without markup."""
    for line in text.splitlines():
        errors.print(f"thincam: {line}", highlight=False, markup=False, soft_wrap=True)


def fail(error: BaseException) -> NoReturn:
    """End for an error that a user can put right."""
    tell(str(error))
    raise typer.Exit(WRONG_INPUT)


def columns(*more: str) -> tuple[rich.progress.ProgressColumn, ...]:
    """Of a progress bar; `more` are templates, as "{task.fields[objective]}"."""
    return (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        *(rich.progress.TextColumn(template) for template in more),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("left"),
        rich.progress.TimeRemainingColumn(),
    )
