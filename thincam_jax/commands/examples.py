"""The command `thincam init`: an example experiment file to begin with, one of `configs/`."""

from pathlib import Path
from typing import Annotated

import typer

from thincam_jax.commands.kinds import KINDS, read_kind
from thincam_jax.commands.terminal import told

# The quickest of each kind have its name; the other files have their own.
_FILE_OF = {name: kind.example for name, kind in KINDS.items() if kind.example not in ("", name)}


def _folder() -> Path:
    """Inside the package where a wheel was installed, else at the root of the repository."""
    installed = Path(__file__).with_name("configs")
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def kinds() -> list[str]:
    """What `thincam init` can write."""
    others = {path.stem for path in _folder().glob("*.yaml")} - set(_FILE_OF.values())
    return [*_FILE_OF, *sorted(others)]


def init(
    kind: Annotated[
        str, typer.Argument(help=f"One of {', '.join(kinds())}.", autocompletion=kinds)
    ],
    out: Annotated[Path | None, typer.Option(help="File, or folder; default KIND.yaml.")] = None,
) -> None:
    """Write an example experiment file to begin with."""
    with told(lambda: "interrupted"):
        from thincam_jax._core.files import write_whole
        from thincam_jax.commands.config_file import ConfigError

        if kind not in kinds():
            raise ConfigError(f"init {kind}: choose one of {', '.join(kinds())}")
        path = out or Path()
        path = path / f"{kind}.yaml" if path.is_dir() else path
        text = (_folder() / f"{_FILE_OF.get(kind, kind)}.yaml").read_text(encoding="utf-8")
        if path.exists():
            raise ConfigError(f"{path} exists; give another --out, or delete it")
        write_whole(path, text)
    print(f"{path}; next: thincam {next_command(kind)} {path}")


def next_command(kind: str) -> str:
    """What takes a file of that name."""
    return read_kind(_folder() / f"{_FILE_OF.get(kind, kind)}.yaml").command
