"""The commands `thincam run`, `design`, `schema`, `explain` and `explore`.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax._core.text import one_of, spelled
from thincam_jax.commands.kinds import KINDS, kind_of, load_experiment
from thincam_jax.commands.terminal import (
    ConfigFile,
    DryRun,
    Overrides,
    counted,
    reported,
    say,
    say_result,
    show,
    warn,
)


def run(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results. Default: runs/NAME.")
    ] = None,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Simulate and reconstruct an experiment.

    Also reconstructs a store of 'thincam capture'. Writes images, metrics.json, figures and
    report.html. Ctrl-C keeps what is finished; the same command goes on from there.
    """
    asked: Any = None
    folder: Any = None

    def interrupted() -> str:
        if getattr(asked, "kind", "study") != "study":
            return "interrupted; the same command starts anew."
        targets = asked.targets if folder else ()
        done = ", ".join(t.name for t in targets if folder.finished(t.name) is not None)
        done = done or "no target yet"
        return f"interrupted; finished: {done}. The same command goes on from there."

    with reported(interrupted):
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.run_folder import RunFolder

        if config.is_dir():
            from thincam_jax.hardware.commands.command import reconstruct_store

            if set_ or dry_run:
                option = "--set" if set_ else "--dry-run"
                raise ConfigError(f"{option} is for experiment files; a store has its own settings")
            say_result("report", reconstruct_store(config, out) / "report.html")
            return
        asked = load_experiment(config, tuple(set_ or ()))
        folder = RunFolder.chosen(out, asked.name, asked)
        kind = kind_of(asked)
        setup = kind.part(kind.build)(asked)
        outcome = folder.outcome(asked)
        warn(getattr(getattr(setup, "study", setup), "warnings", []))
        if dry_run:
            explain_run(asked, outcome, setup)
            return
        with counted(asked.name) as progress:
            found = kind.part(kind.run)(setup, folder, progress)
    show(found.table())
    say_result("report", folder.path / "report.html")


def design(
    config: Annotated[
        Path, typer.Argument(help="Experiment file (YAML) of kind 'design' or 'cells'.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results. Default: runs/NAME.")
    ] = None,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Search for the best design.

    Simulates it beside the design to beat; or finds masks whose every cell is free. Writes
    design.json, figures, report.html, and found.yaml or files of the masks. Ctrl-C keeps what is
    finished; the same command goes on from there.
    """
    goes_on = "interrupted; the same command goes on with what is not finished."
    with reported(lambda: goes_on):
        from thincam_jax.commands.design.run import DesignFolder

        wanted = load_experiment(config, tuple(set_ or ()), "design")
        kind = kind_of(wanted)
        study = kind.part(kind.build)(wanted)
        warn(study.warnings)
        folder = DesignFolder.chosen(out, wanted.name, wanted)
        if dry_run:
            explain_run(wanted, folder.outcome(wanted))
            return
        with counted(wanted.name) as progress:
            found = kind.part(kind.run)(study, folder, progress)
    show(found.table())
    say(found.levels())
    say_result("report", folder.path / "report.html")


def schema(
    kind: Annotated[
        str,
        typer.Argument(
            help=f"Kind of file: {', '.join(KINDS)}.", autocompletion=lambda: list(KINDS)
        ),
    ],
) -> None:
    """Print the JSON Schema of a kind of file.

    Editors complete and check experiment files with it.
    """
    with reported(lambda: "interrupted"):
        import json

        from thincam_jax.commands.config_file import ConfigError

        if kind not in KINDS:
            raise ConfigError(f"kind: {kind!r} is unknown; {one_of(kind, KINDS)}")
        form = KINDS[kind].part(KINDS[kind].section).model_json_schema()
    say(json.dumps(form, indent=2))


def explain(config: ConfigFile, set_: Overrides = None) -> None:
    """Print the values of an experiment file.

    Each with its unit and its line, or "default"; and the work of a run: error, memory and
    operations of PSFs, rays of a screen, evaluations of a search, frames of a capture, steps of a
    training.
    """
    with reported(lambda: "interrupted"):
        asked = load_experiment(config, tuple(set_ or ()), command=None)
        rows = list(values(asked))
        width = max(len(f"{key}: {value}") for key, value, _ in rows if len(value) <= _LONGEST)
        lines = [f"{f'{key}: {value}':<{width}}  # {place}" for key, value, place in rows]
        costly = list(costs(asked))
        result = {"values": {key: value for key, value, _ in rows}, "costs": costly}
        say_result("experiment", result, "\n".join([*lines, *costly]))


_LONGEST = 50  # characters of a value that places are lined up behind


def values(asked: Any) -> Iterator[tuple[str, str, str]]:
    """Key, value and place of every entry of a checked file; "default" where it has none."""
    data = asked.model_dump(mode="json", exclude_none=True, by_alias=True, exclude={"notes"})
    for location, value in _entries(data):
        key = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in location)
        place = asked.place_of(*location).removesuffix(": ") if asked.gives(*location) else ""
        yield key.removeprefix("."), value, place or "default"


def _entries(data: Any, location: tuple = ()) -> Iterator[tuple[tuple, str]]:
    """Values by location; a list of values is one."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in inner:
        inside = value if isinstance(value, list) else ()
        if isinstance(value, dict) or any(isinstance(one, (dict, list)) for one in inside):
            yield from _entries(value, (*location, key))
        else:
            text = (
                f"[{', '.join(map(spelled, value))}]" if isinstance(value, list) else spelled(value)
            )
            yield (*location, key), text


def explain_run(asked: Any, writes: str, setup: Any = None) -> None:
    """Print what a command would compute and write, for its option `--dry-run`.

    The names of each list of the file, and the costs.
    """
    lines = []
    for key, entries in asked:
        if entries and isinstance(entries, tuple) and all(hasattr(e, "name") for e in entries):
            lines.append(f"{len(entries)} {key}: {'; '.join(entry.name for entry in entries)}")
    lines += [*costs(asked, setup), writes, "dry run: nothing was done"]
    say_result("dry_run", lines, "\n".join(lines))


def costs(asked: Any, setup: Any = None) -> Iterator[str]:
    """Work of a file's run, in numbers; `setup`: objects built of it, where they are."""
    kind = kind_of(asked)
    return kind.part(kind.costs)(asked, setup)


Port = Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")]
Browser = Annotated[bool, typer.Option(help="Open the page in a browser.")]


def serve_page(shown: Any, title: str, port: int, browser: bool) -> None:
    """Serve until Ctrl-C, and say where. **Errors**: ConfigError, one line."""
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.plot.page import serve

    try:
        told_of = lambda at: say_result("address", at, f"{at}\nCtrl-C ends it.")  # noqa: E731
        serve(shown, title, port, told_of, browser)
    except ImportError:
        raise ConfigError("pages need pip install 'thincam_jax[notebook]'") from None
    except OSError as error:
        fault = f"--port {port}: {error.strerror}"
        raise ConfigError(f"{fault}; give another, or leave it out") from None


def explore(
    config: ConfigFile, set_: Overrides = None, port: Port = 0, browser: Browser = True
) -> None:
    """Change a camera's numbers and see its PSF.

    Opens a page in the browser with the first camera of a study. Only this machine reaches it, and
    only with the address that is printed. Ctrl-C ends it.
    """
    with reported(lambda: "interrupted"):
        from thincam_jax.commands.kinds import load_study

        asked = load_study(config, tuple(set_ or ()), "explore takes a study")
        from thincam_jax.commands.study.build import build_study
        from thincam_jax.plot.explorer import Explorer

        study = build_study(asked)
        exposure = study.exposures[0]
        light = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
        explorer = Explorer(study.camera(exposure), **light)
        serve_page(explorer, asked.name, port, browser)
