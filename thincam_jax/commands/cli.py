"""The command `thincam`.

What a command computes with is imported when it runs: help and the shell's completion need none of
it. Hence the files `command.py` import nothing slow at their heads.
"""

import functools
import inspect
import os
from collections.abc import Callable
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

from thincam_jax._core.program_cache import cache_state, keep_programs
from thincam_jax.commands import terminal
from thincam_jax.commands.evaluate.command import evaluate, info
from thincam_jax.commands.kinds import commands_of_rooms, has_room, init, load_experiment
from thincam_jax.commands.plate import plate
from thincam_jax.commands.reconstruct.command import check, examine, reconstruct
from thincam_jax.commands.run import design, explain, explore, run, schema
from thincam_jax.commands.sweep.command import sweep
from thincam_jax.commands.terminal import reported, say, say_result

ORDER = (
    *("init", "explain", "explore", "run", "preview", "capture", "examine", "reconstruct"),
    *("calibrate", "dataset", "evaluate", "sweep", "design", "plate", "train", "schema", "doctor"),
)
# Of `thincam reconstruct`; what is in none stands first.
GROUPS = {
    "Calibration": (
        *("background", "psf_background", "dead", "bits", "psf_bits", "saturation", "noise"),
    ),
    "Preparation": (
        *("downsample", "bayer", "demosaic", "noise_threshold", "psf_channels", "psf_scale"),
        "corner",
    ),
    "Reconstruction": ("method", "tau", "ridge", "iterations", "coupling"),
    "Image": ("field", "flip", "linear", "gamma", "white_balance"),
}
_COMPARISON = {"Comparison": ("truth", "truth_area", "fit", "shift", "published")}


class InOrder(TyperGroup):
    """Commands in the order in which a user needs them; one that is not listed comes last."""

    def list_commands(self, ctx: Any) -> list[str]:
        known = {name: place for place, name in enumerate(ORDER)}
        return sorted(super().list_commands(ctx), key=lambda name: known.get(name, len(known)))


def with_output(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of what it prints."""
    own = inspect.signature(command)
    flags = {
        "as_json": ("--json", "Print results as JSON, an object in a line, without progress."),
        "quiet": ("--quiet", "Print warnings and errors only."),
    }
    more = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=False,
            annotation=Annotated[bool, typer.Option(flag, help=text)],
        )
        for name, (flag, text) in flags.items()
    ]

    @functools.wraps(command)
    def call(*, as_json: bool, quiet: bool, **given: Any) -> None:
        terminal.output = "json" if as_json else "nothing" if quiet else "text"
        command(**given)

    cast(Any, call).__signature__ = own.replace(parameters=[*own.parameters.values(), *more])
    return call


class Once(TyperCommand):
    """Refuses an option that is given twice and takes one value: the first would be lost."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for one in set(order):
            is_value = one.nargs == 1 and not (one.multiple or getattr(one, "is_flag", False))
            if is_value and order.count(one) > 1:
                ctx.fail(f"{one.opts[0]} is given {order.count(one)} times; give it once")
        return super().parse_args(ctx, args)


class Grouped(Once):
    """Options in groups, and nothing else: for a file, the command that takes it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0].endswith((".yaml", ".yml")):
            with reported(lambda: "interrupted"):
                load_experiment(args[0], (), self.name)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        groups = GROUPS | _COMPARISON
        group_of = {name: group for group, names in groups.items() for name in names}
        rows: dict[str, list] = {"Options": [], **{group: [] for group in groups}}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                rows[group_of.get(parameter.name or "", "Options")].append(record)
        for group, records in ((g, r) for g, r in rows.items() if r):
            with formatter.section(group):
                formatter.write_dl(records)


# Help without colours and boxes, which take longer than all the rest of it.
app = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None, cls=InOrder
)
# The callback keeps the name of a single command.
calibrate = typer.Typer(no_args_is_help=True, help="Check a calibration by captures.")
calibrate.callback()(lambda: None)
dataset = typer.Typer(no_args_is_help=True, help="Look at a data set of captures and truths.")
dataset.callback()(lambda: None)
for group, command, *examples in (
    (app, init, "init study", "init design --sensor 1500x2000 --pitch 3.45um --out mine.yaml"),
    (app, schema, "schema study > study.schema.json"),
    (app, explain, "explain study.yaml", "explain study.yaml --set noise.snr_db=40"),
    (app, explore, "explore study.yaml", "explore study.yaml --set mask.width=3mm --no-browser"),
    (app, run, "run study.yaml", "run study.yaml --set noise.snr_db=40 --dry-run"),
    (
        *(app, reconstruct),
        "reconstruct --psf PSF.tif --capture RAW.tif --downsample 4 --out IMAGE.png",
        "reconstruct --psf PSF.png --capture CAPTURES --background DARK.png --out IMAGES",
    ),
    (
        *(app, sweep),
        "sweep study.yaml --grid seed=0:4:5",
        'sweep study.yaml --grid "methods.*.shots.*.beta=15:30:4 rad/mm^2"',
    ),
    (
        *(app, evaluate, "evaluate DATASET --method admm-tv --method ridge --limit 100"),
        "evaluate DATASET --split test --fit maximum --truth linear --out runs/comparison",
    ),
    (dataset, info, "dataset info DATASET"),
    (app, design, "design design.yaml", "design design.yaml --out found"),
    (
        *(app, plate),
        "plate study.yaml --out plate.gds --halftone 4um",
        "plate study.yaml --out plate.tif --pixel 1um --shot 2",
    ),
    (app, examine, "examine RAW.tif --psf PSF.tif", "examine CAPTURES/*.tif --json"),
    (calibrate, check, "calibrate check --psf PSF.tif --capture RAW.tif"),
    *((app, *one) for one in commands_of_rooms()),
):
    layout = Grouped if command in (reconstruct, check, evaluate) else Once
    printing = command if command is schema else with_output(command)  # a schema is JSON
    told_last = "\n".join(["\b", "Examples:", *(f"  thincam {line}" for line in examples)])
    group.command(cls=layout, epilog=told_last)(printing)
app.add_typer(calibrate, name="calibrate")
app.add_typer(dataset, name="dataset")


def _print_version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        say(f"thincam_jax {version('thincam_jax')}")
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
    os.environ["THINCAM_CACHE"] = "on" if cache else "off"
    os.environ["THINCAM_PROGRESS"] = "off"  # commands have bars
    if cache:
        keep_programs()


@app.command()
@with_output
def doctor(
    devices: Annotated[
        bool, typer.Option(help="List connected devices, without opening any.")
    ] = False,
    ask: Annotated[str | None, typer.Option(help="Serial port to ask for its device.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="List versions, precisions and drivers, too.")
    ] = False,
) -> None:
    """Show what works here and what is missing."""
    with reported(lambda: "interrupted"):
        from thincam_jax._core.environment import machine_report, package_report, verdict

        lines = verdict()
        if everything:
            programs = f"compiled programs: {cache_state()}"
            lines += [*machine_report(), programs, *package_report()]
        else:
            lines.append("versions, precisions and drivers: thincam doctor --all")
        if (everything or devices or ask) and has_room("hardware"):
            from thincam_jax.hardware.commands.command import known_drivers

            lines += known_drivers(devices, ask)
        say_result("report", lines, "\n".join(lines))
