"""What the commands share: consoles, exit codes, and how an error is told."""

from typing import Annotated, NoReturn

import rich.console
import rich.progress
import typer

from thincam_jax.commands.config_file import ConfigError

console = rich.console.Console()
errors = rich.console.Console(stderr=True)

WRONG_INPUT = 2
INTERRUPTED = 130  # the shells' exit code after Ctrl-C

# What a user can put right; anything else is a defect and keeps its traceback.
USER_ERRORS = (ConfigError, FileNotFoundError, IsADirectoryError, PermissionError, MemoryError)

Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a value: a.b=value, list entries by number."),
]


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
