"""The command `thincam`.

What a command computes with is imported when it runs: help and the shell's completion need none of
it. Hence the files `command.py` import nothing slow at their heads.
"""

from typing import Annotated

import typer

from thincam_jax.commands.accuracy.command import accuracy
from thincam_jax.commands.cache import cache_state, keep_programs
from thincam_jax.commands.design.command import design
from thincam_jax.commands.examples import init
from thincam_jax.commands.photo.command import reconstruct
from thincam_jax.commands.start import main
from thincam_jax.commands.study.command import run
from thincam_jax.commands.sweep.command import sweep

# Help without colours and boxes, which take longer than all the rest of it.
app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
bench = typer.Typer(no_args_is_help=True, help="Measure what the models of a study cost.")
bench.command()(accuracy)
for command in (init, run, reconstruct, sweep, design):
    app.command()(command)
app.add_typer(bench, name="bench")


def _print_version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        print(f"thincam_jax {version('thincam_jax')}")
        raise typer.Exit
    return asked


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
    cache: Annotated[
        bool,
        typer.Option(
            "--cache/--no-cache",
            envvar="THINCAM_CACHE",
            help="Keep compiled programs for the next run.",
        ),
    ] = True,
) -> None:
    """Simulate and reconstruct thin computational cameras."""
    if cache:
        keep_programs()


@app.command()
def doctor() -> None:
    """Print versions, devices and what is missing."""
    from thincam_jax.commands import doctor as doctoring

    found = doctoring.environment()
    print(f"Python {found['python']} on {found['platform']}")
    print("devices: " + ", ".join(found["devices"]))
    for name, support in doctoring.dtype_support().items():
        print(f"  {name}: {support}")
    print(f"  compiled sums: {doctoring.compiled_sums()}")
    print(f"compiled programs: {cache_state()}")
    for name, version in found["versions"].items():
        print(f"{name} {version or 'NOT INSTALLED'}")
    for name, purpose in doctoring.missing_parts().items():
        print(f"optional {name} is missing: {purpose}")


if __name__ == "__main__":
    main()
