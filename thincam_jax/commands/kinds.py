"""The kinds of experiment files, where their parts are, and `thincam init`, which writes examples.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import reported, say, say_result, show


@dataclass(frozen=True)
class Kind:
    """One kind of experiment file.

    - `noun`: name of such a file. `command`: command of `thincam` that takes it.
    - `section`: its configuration, as MODULE:NAME in the `commands` of its room or the package.
    - `costs`: function of a configuration and its objects that gives lines about its run.
    - `example`: the file of `configs/` that `thincam init` writes under the kind's name.
    - `build`, `run`: functions. For `thincam run` and `design`: makes objects of the configuration,
      and runs these into a folder; its result has a `table`, and `levels` of a design. For
      `thincam train`: makes the lessons, and trains in a folder.
    - `room`: its room, one of `ROOMS`, if any.
    """

    noun: str
    command: str
    section: str
    costs: str
    example: str = ""
    build: str = ""
    run: str = ""
    room: str = ""

    def part(self, place: str) -> Any:
        """The object at MODULE:NAME, imported when it is needed."""
        return _part(self.room, place)


# Rooms that an installation may leave out, with all that is theirs, and whether commands are.
ROOMS = {"waveguide": False, "hardware": True, "learn": True}


def has_room(room: str) -> bool:
    """Whether the installation has a room of the package."""
    return (Path(__file__).parents[1] / room / "__init__.py").is_file()


def commands_of_rooms() -> Iterator[tuple[Any, ...]]:
    """Functions and examples of the commands that come with rooms."""
    for room, has_commands in ROOMS.items():
        if has_commands and has_room(room):
            yield from _part(room, "command:COMMANDS")


def section_of(room: str, place: str) -> Any:
    """A section of another room's files; without the room one that is refused."""
    if has_room(room):
        return _part(room, place)
    from pydantic import BeforeValidator

    def refuse(_: Any) -> None:
        raise ValueError(_needs(room))

    return Annotated[None, BeforeValidator(refuse)]


def _part(room: str, place: str) -> Any:
    module, name = place.split(":")
    parts = ("thincam_jax", room, "commands", module)
    return getattr(import_module(".".join(filter(None, parts))), name)


def _needs(room: str) -> str:
    return f"needs thincam_jax.{room}, which this installation has not"


# By the `kind` of their files; a study's file does not name it.
_ALL = {
    "study": Kind(
        *("a study", "run", "sections:StudyConfig", "study.build:psfs", "quick"),
        *("study.build:build_study", "study.run:run_study"),
    ),
    "refocus": Kind(
        *("a refocusing", "run", "refocus:RefocusConfig", "study.build:psfs", "fza_refocus"),
        *("refocus:build_refocus", "refocus:run_refocus"),
    ),
    "screen": Kind(
        *("a see-through screen", "run", "config:ScreenConfig", "run:rays"),
        *("sts_camera", "run:build_screen", "run:run_screen", "waveguide"),
    ),
    "design": Kind(
        *("a design", "design", "design.config:DesignConfig", "design.build:search"),
        *("design_distances", "design.build:build_design", "design.run:run_design"),
    ),
    "cells": Kind(
        *("a search for cells", "design", "design.cells:FreeCellsConfig", "design.cells:work"),
        *("design_cells", "design.cells:build_cells", "design.cells:run_cells"),
    ),
    "capture": Kind(
        *("a capture", "capture", "config:CaptureConfig", "command:frames"),
        "rig_virtual",
        room="hardware",
    ),
    "denoiser": Kind(
        *("a denoiser", "train", "denoiser:DenoiserConfig", "training:lessons"),
        *("denoiser", "denoiser:build_lessons", "denoiser:run_denoiser", "learn"),
    ),
    "trained": Kind(
        *("a trained reconstruction", "train", "trained:TrainedConfig", "training:lessons"),
        *("trained", "trained:build_lessons", "trained:run_trained", "learn"),
    ),
}
KINDS = {name: kind for name, kind in _ALL.items() if not kind.room or has_room(kind.room)}


def kind_of(config: Any) -> Kind:
    """The kind of a configuration."""
    return KINDS[getattr(config, "kind", "study")]


def read_kind(path: str | Path) -> Kind:
    """The kind of an experiment file.

    **Errors**: ConfigError for an unknown one.
    """
    from thincam_jax.commands.config_file import ConfigError, read_raw

    given = read_raw(Path(path))[0].get("kind")
    named = {name: kind for name, kind in KINDS.items() if name != "study"}
    if given is None:
        return KINDS["study"]
    if isinstance(given, str) and given in named:
        return named[given]
    if isinstance(given, str) and given in _ALL and given != "study":
        raise ConfigError(f"{path}: kind: {given} {_needs(_ALL[given].room)}")
    *others, last = named
    raise ConfigError(
        f"{path}: kind: {given!r} is unknown; write {', '.join(others)} or {last}, or leave it out "
        "for a study"
    )


def load_experiment(
    path: str | Path, overrides: tuple[str, ...] = (), command: str | None = "run"
) -> Any:
    """Read and check an experiment file that a command takes; errors as of `load_as`.

    `command`: None for a file of any kind.
    """
    from thincam_jax.commands.checked_config import load_as
    from thincam_jax.commands.config_file import ConfigError

    kind = read_kind(path)
    if command is not None and kind.command != command:
        raise ConfigError(f"{path}: is {kind.noun}; give it to 'thincam {kind.command}'")
    return load_as(kind.part(kind.section), path, overrides)


def load_study(path: str | Path, overrides: tuple[str, ...], needs: str) -> Any:
    """Read and check a study; errors as of `load_experiment`, which say what `needs` one."""
    from thincam_jax.commands.config_file import ConfigError

    config = load_experiment(path, overrides)
    if kind_of(config) is not KINDS["study"]:
        raise ConfigError(f"{path}: is of kind {config.kind}; {needs}")
    return config


# The quickest of each kind have its name; the other files have their own.
_FILE_OF = {name: kind.example for name, kind in KINDS.items() if kind.example not in ("", name)}


def _folder() -> Path:
    """Inside the package where a wheel was installed, else at the root of the repository."""
    installed = Path(__file__).with_name("configs")
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def examples() -> list[str]:
    """Names that `thincam init` takes."""
    others = {path.stem for path in _folder().glob("*.yaml")} - set(_FILE_OF.values())
    return [*_FILE_OF, *sorted(others)]


def _source(example: str) -> Path:
    return _folder() / f"{_FILE_OF.get(example, example)}.yaml"


def init(
    example: Annotated[
        str | None,
        typer.Argument(
            help="Name of an example. Without it, all are listed.", autocompletion=examples
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File or folder to write to. Default: EXAMPLE.yaml.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help="Pixels of your sensor, such as 1500x2000; with 'design' only."),
    ] = None,
    pitch: Annotated[
        str | None, typer.Option(help="Pixel pitch of your sensor, such as 3.45um.")
    ] = None,
) -> None:
    """Write an example experiment file, or list all."""
    with reported(lambda: "interrupted"):
        import yaml

        from thincam_jax._core.files import write_whole
        from thincam_jax._core.table import Table
        from thincam_jax._core.text import one_of
        from thincam_jax.commands.config_file import ConfigError, read_raw

        if example is None:
            raw = {one: read_raw(_source(one))[0] for one in examples()}
            rows = [(one, r.get("kind", "study"), r["title"]) for one, r in raw.items()]
            show(Table(("example", "kind", "experiment"), rows))
            say("next: thincam init EXAMPLE")
            return
        if example not in (*examples(), *_FILE_OF.values()):
            raise ConfigError(f"init {example}: {one_of(example, examples())}")
        path = out or Path()
        path = path / f"{example}.yaml" if path.is_dir() else path
        own = sensor is not None or pitch is not None
        if own and example != "design":
            raise ConfigError("--sensor and --pitch are for a design: thincam init design")
        source = _source("design_sensor" if own else example)
        text, command = source.read_text(encoding="utf-8"), read_kind(source).command
        if own:
            from thincam_jax.commands.design.own_sensor import with_sensor

            text = with_sensor(text, sensor or "", pitch or "")
        # A copy may lie anywhere; its schema stays with the package that reads it.
        text = text.replace("$schema=", f"$schema={_folder().as_uri()}/", 1)
        # One name for the file, the experiment and its run folder.
        name = yaml.safe_dump(re.sub(r"[^\w .,()=+-]", "_", path.stem), allow_unicode=True)
        text = re.sub("^name: .*$", f"name: {name.split(chr(10))[0]}", text, count=1, flags=re.M)
        if path.exists():
            raise ConfigError(f"{path} exists; give another --out, or delete it")
        write_whole(path, text)
    say_result("file", path, f"{path}; next: thincam {command} {path}")
