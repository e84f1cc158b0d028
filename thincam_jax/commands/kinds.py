"""The kinds of experiment files, where their parts are, and `thincam init`, which writes examples.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import say, told


@dataclass(frozen=True)
class Kind:
    """One kind of experiment file.

    - `noun`: what such a file is. `command`: of `thincam`, that takes it.
    - `section`: its configuration, as MODULE:NAME in `thincam_jax.commands`.
    - `example`: the file of `configs/` that `thincam init` writes under the kind's name.
    - `build`, `run`: of those for `thincam run`, what makes objects of the configuration, and what
      runs these into a folder; its result has a `table`. Of those for `thincam train`, what makes
      the lessons, and what trains in a folder.
    """

    noun: str
    command: str
    section: str
    example: str = ""
    build: str = ""
    run: str = ""

    def part(self, place: str) -> Any:
        """What is at MODULE:NAME, imported when it is needed."""
        module, name = place.split(":")
        return getattr(import_module(f"thincam_jax.commands.{module}"), name)


def _run(room: str, section: str, name: str, example: str = "") -> Kind:
    """A kind for `thincam run`, whose parts are where those of its room are."""
    parts = f"{room}.run:build_{room}", f"{room}.run:run_{room}"
    return Kind(name, "run", f"{room}.config:{section}", example, *parts)


# By the `kind` of their files; a study's file does not name it.
KINDS = {
    "study": Kind(
        *("a study", "run", "study.config:StudyConfig", "quick"),
        *("study.build:build_study", "study.run:run_study"),
    ),
    "refocus": _run("refocus", "RefocusConfig", "a refocusing", "fza_refocus"),
    "screen": _run("screen", "ScreenConfig", "a see-through screen"),
    "design": Kind("a design", "design", "design.config:DesignConfig", "design_distances"),
    "capture": Kind("a capture", "capture", "capture.config:CaptureConfig", "rig_virtual"),
    "learned": Kind(
        *("a network", "train", "learned.config:LearnedConfig", "learned_refocus"),
        build="learned.run:build_lessons",
        run="learned.run:run_training",
    ),
    "denoiser": Kind(
        *("a denoiser", "train", "learned.denoiser:DenoiserConfig", "denoiser"),
        build="learned.denoiser:build_lessons",
        run="learned.denoiser:run_denoiser",
    ),
}


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
    *others, last = (f"'kind: {name}'" for name, kind in named.items() if kind.command == "run")
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
        raise ConfigError(f"{path}: kind: is {kind.noun}; give it to 'thincam {kind.command}'")
    return load_as(kind.part(kind.section), path, overrides)


# The quickest of each kind have its name; the other files have their own.
_FILE_OF = {name: kind.example for name, kind in KINDS.items() if kind.example not in ("", name)}


def _folder() -> Path:
    """Inside the package where a wheel was installed, else at the root of the repository."""
    installed = Path(__file__).with_name("configs")
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def examples() -> list[str]:
    """What `thincam init` can write."""
    others = {path.stem for path in _folder().glob("*.yaml")} - set(_FILE_OF.values())
    return [*_FILE_OF, *sorted(others)]


def init(
    kind: Annotated[
        str, typer.Argument(help=f"One of {', '.join(examples())}.", autocompletion=examples)
    ],
    out: Annotated[Path | None, typer.Option(help="File, or folder; default KIND.yaml.")] = None,
) -> None:
    """Write an example experiment file to begin with."""
    with told(lambda: "interrupted"):
        from thincam_jax._core.files import write_whole
        from thincam_jax.commands.config_file import ConfigError

        if kind not in examples():
            raise ConfigError(f"init {kind}: choose one of {', '.join(examples())}")
        path = out or Path()
        path = path / f"{kind}.yaml" if path.is_dir() else path
        text = (_folder() / f"{_FILE_OF.get(kind, kind)}.yaml").read_text(encoding="utf-8")
        if path.exists():
            raise ConfigError(f"{path} exists; give another --out, or delete it")
        write_whole(path, text)
    say(f"{path}; next: thincam {next_command(kind)} {path}")


def next_command(kind: str) -> str:
    """What takes a file of that name."""
    return read_kind(_folder() / f"{_FILE_OF.get(kind, kind)}.yaml").command
