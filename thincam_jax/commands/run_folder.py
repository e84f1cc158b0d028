"""A run: the list of its work, its folder, and how an interrupted one goes on."""

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pydantic
from filelock import FileLock, Timeout

from thincam_jax._core.environment import environment, installed
from thincam_jax._core.files import WriteError, file_digest, read_json, read_regular, write_whole
from thincam_jax._core.precision import is_double
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.text import slug
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.report import Page, render_report
from thincam_jax.commands.schema import Section
from thincam_jax.commands.sections import ExperimentConfig
from thincam_jax.commands.terminal import tell
from thincam_jax.imaging.encoding import png_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Running = TypeVar("Running", bound="Run")
Folder = TypeVar("Folder", bound="RunFolder")
_LOCK, _ORIGIN, _SUM = ".lock", "inputs.json", "sha256"
FILE_KEYS = ("path", "start")  # of experiment files, that name a file or a folder of files


class RunFolder:
    """Files of one run. Every file is written whole or not at all.

    - `config.yaml`: the resolved configuration. `inputs.json`: see `origin_of`.
    - `targets/NAME.json`: the metrics of a finished target; an interrupted study skips these.
    - `images/`: reconstructions and scenes, `figures/`: the report's pictures.
    - `environment.json`, `report.html` and, last, the `result`: written at the end.
    """

    kind, config = "run", "config.yaml"
    folders: tuple[str, ...] = ("targets", "images", "figures")
    pictures = "figures"
    result = "metrics.json"
    others = ("environment.json", "report.html")

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @classmethod
    def chosen(cls: type[Folder], out: Path | None, name: str, config: Section) -> Folder:
        """The folder given, or runs/NAME; if another run has that, runs/NAME-2 and so on."""
        first, number = out or Path("runs") / slug(name), 1
        folder = cls(first)
        while out is None and not folder._is_open_to(config):
            number += 1
            folder = cls(first.with_name(f"{first.name}-{number}"))
        if number > 1:
            tell(f"{first} holds another configuration: writes to {folder.path}")
        return folder

    def _is_open_to(self, config: Section) -> bool:
        try:
            self.outcome(config)
        except ConfigError:
            return False
        return True

    def claim(self, config: Section) -> None:
        """Make the folder; an interrupted run goes on, a complete one is done anew.

        So is one of other inputs: files that the configuration names, the package, the precision.
        """
        self.make(config)
        if (self.path / self.result).exists() or self.changed(config):
            for finished in (self.path / "targets").glob("*"):
                finished.unlink()
            (self.path / self.result).unlink(missing_ok=True)
        self.write(_ORIGIN, to_json(origin_of(config)))

    def changed(self, config: Section) -> list[str]:
        """Inputs that are others than those of the results that the folder holds."""
        was, now = read_entries(self.path / _ORIGIN), origin_of(config)
        return [name for name in sorted({*was, *now}) if was.get(name) != now.get(name)]

    def make(self, config: Section) -> None:
        """Make the folder and write the configuration; one of the same is taken as it is.

        **Errors**: ConfigError where the folder holds anything else, or cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._refuse_foreign(config)
            self._lock = FileLock(self.path / _LOCK, is_singleton=True)
            self._lock.acquire(timeout=0)
            self.write(self.config, dump_config(config))
            for folder in self.folders:
                (self.path / folder).mkdir(exist_ok=True)
        except Timeout:
            text = "writes to it; wait for its end or give another folder"
            raise ConfigError(f"--out {self.path}: another {self.kind} {text}") from None
        except WriteError:
            raise
        except OSError as error:
            text = f"--out {self.path}: cannot be made a folder ({error.strerror})"
            raise ConfigError(text) from None

    def outcome(self, config: Section) -> str:
        """Files that a run would write, in a line; ConfigError where `make` refuses the folder."""
        if self.path.exists():
            self._refuse_foreign(config)
        folders = [f"{folder}/" for folder in self.folders]
        files = (self.config, *folders, *self.others, self.result)
        return f"writes to {self.path}: {', '.join(files)}"

    def _refuse_foreign(self, config: Section) -> None:
        if not self.path.is_dir():
            raise ConfigError(f"--out {self.path}: cannot be made a folder (it is a file)")
        held = self.path / self.config
        # Its lock and a partial file are all that is there where the first start was killed.
        foreign = any(p.name != _LOCK and p.suffix != ".partial" for p in self.path.iterdir())
        if held.exists():
            if read_regular(held) != dump_config(config).encode("utf-8"):
                raise ConfigError(
                    f"--out {self.path}: holds a {self.kind} of another configuration (see {held});"
                    " give another folder or delete this one"
                )
        elif foreign:
            message = f"is not empty and holds no {self.kind}; give a new folder"
            raise ConfigError(f"--out {self.path}: {message}")

    def finished(self, target: str) -> dict[str, Any] | None:
        """The stored results of a target; None if it has not been finished or is damaged."""
        return self.entries(f"targets/{slug(target)}.json")

    def finish(self, target: str, results: dict[str, Any]) -> None:
        """Store the results of a target."""
        self.write_entries(f"targets/{slug(target)}.json", results)

    def entries(self, name: str) -> dict[str, Any] | None:
        """Entries that `write_entries` wrote; None where the file is missing or damaged."""
        held = read_entries(self.path / name)
        return held if held.pop(_SUM, None) == digest(to_json(held)) else None

    def write_entries(self, name: str, entries: dict[str, Any]) -> None:
        """Write entries with their sum."""
        self.write(name, to_json({**entries, _SUM: digest(to_json(entries))}))

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file of the folder, whole or not at all."""
        return write_whole(self.path / name, content)

    def save_figure(self, name: str, figure: "Figure") -> None:
        """A figure as figures/NAME.png."""
        from thincam_jax.plot.frame import as_png

        self.write(f"{self.pictures}/{name}.png", as_png(figure))

    def save_image(self, name: str, image: np.ndarray) -> None:
        """An image of values 0…1 as an 8-bit PNG."""
        pixels = np.round(np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
        self.write(f"images/{name}.png", png_bytes(pixels))

    def complete(
        self, page: Page, config: ExperimentConfig, metrics: dict[str, Any], started: float
    ) -> None:
        """Write what surrounds the run, its page, and its result, last."""
        surroundings = environment(time.time() - started)
        self.write("environment.json", to_json({**surroundings, "seed": config.seed}))
        content = render_report(page, config, self.path, surroundings, self.pictures)
        self.write("report.html", content)
        self.write(self.result, to_json(metrics))


class Run:
    """An experiment on its way: its `work`, which ends with a report, fills `metrics`.

    Claims the folder. An interrupted run is done anew, but for what the folder holds of it.
    """

    def __init__(self, config: Any, folder: RunFolder):
        self.config, self.folder, self.started = config, folder, time.time()
        self.metrics: dict[str, Any] = {}
        self.work: list[Step] = []
        folder.claim(config)

    def add(self, text: str, do: Callable[..., object], *arguments: Any) -> None:
        """A step to the work."""
        self.work.append(Step(text, partial(do, *arguments)))

    def carry_out(self: Running, progress: Progress) -> Running:
        """Do the work; returns the run itself."""
        carry_out(self.work, progress)
        return self

    def complete(self, page: Page) -> None:
        """The page, the metrics, and all that ends the folder."""
        self.folder.complete(page, self.config, self.metrics, self.started)


def to_json(data: Any) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_entries(path: Path) -> dict[str, Any]:
    """Entries that `to_json` wrote; none of a file with anything else, or that is not there."""
    with contextlib.suppress(OSError, ValueError):
        held = read_json(path)
        return dict(held) if isinstance(held, dict) and to_json(held).encode("utf-8") else {}
    return {}


def origin_of(config: pydantic.BaseModel) -> dict[str, str]:
    """Package, precision, and SHA-256 of each file and of those in folders that a file names."""
    found = installed(("thincam_jax",)) | {"precision": "float64" if is_double() else "float32"}
    for name in _named(config.model_dump(mode="json")):
        for path in name.iterdir() if name.is_dir() else (name,):
            with contextlib.suppress(OSError):
                found[str(path)] = file_digest(path)
    return found


def _named(data: Any, key: str = "") -> Iterator[Path]:
    """Files and folders that are named below an entry."""
    if key in FILE_KEYS and isinstance(data, str):
        yield Path(data)
    elif isinstance(data, list | dict):
        for name, value in data.items() if isinstance(data, dict) else (("", one) for one in data):
            yield from _named(value, name)


def digest(text: str) -> str:
    """SHA-256 of a text."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def as_record(kind: Any, data: Any) -> Any:
    """A dataclass, or a dictionary of them, from what a file holds of it: `asdict` undone."""
    return pydantic.TypeAdapter(kind).validate_python(data)
