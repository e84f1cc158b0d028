"""A run: the list of its work, its folder, and how an interrupted one goes on."""

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pydantic
from filelock import FileLock, Timeout

from thincam_jax._core.environment import environment
from thincam_jax._core.files import WriteError, read_regular, write_whole
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError, slug
from thincam_jax.commands.report import Page, render_report
from thincam_jax.commands.sections import ExperimentConfig, Section
from thincam_jax.imaging.display import png_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Record = TypeVar("Record")
_LOCK = ".lock"


class RunFolder:
    """Files of one run. Every file is written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `targets/NAME.json`: the metrics of a finished target; an interrupted study skips these.
    - `images/`: reconstructions and scenes, `figures/`: the report's pictures.
    - `environment.json`, `report.html` and, last, the `result`: written at the end.
    """

    kind = "run"
    folders: tuple[str, ...] = ("targets", "images", "figures")
    pictures = "figures"
    result = "metrics.json"
    others = ("environment.json", "report.html")

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def claim(self, config: Section) -> None:
        """Make the folder and write the configuration; refuse a folder that holds anything else.

        An interrupted run of the same configuration goes on; a complete one is done anew.
        """
        text = dump_config(config)
        self._lock = claim_folder(self.path, "config.yaml", text, self.kind, self.folders)
        if (self.path / self.result).exists():
            for finished in (self.path / "targets").glob("*.json"):
                finished.unlink()
            (self.path / self.result).unlink()

    def outcome(self, config: Section) -> str:
        """What a run would write, in a line; ConfigError where `claim` would refuse the folder."""
        if self.path.exists():
            refuse_foreign(self.path, "config.yaml", dump_config(config), self.kind)
        folders = [f"{folder}/" for folder in self.folders]
        files = ("config.yaml", *folders, *self.others, self.result)
        return f"writes to {self.path}: {', '.join(files)}"

    def finished(self, target: str) -> dict[str, Any] | None:
        """The stored results of a target, or None if it has not been finished."""
        path = self.path / "targets" / f"{slug(target)}.json"
        try:
            return json.loads(read_regular(path))
        except (OSError, json.JSONDecodeError):
            return None

    def finish(self, target: str, results: dict[str, Any]) -> None:
        self.write(f"targets/{slug(target)}.json", to_json(results))

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
        pictures = self.path / self.pictures
        self.write("report.html", render_report(page, config, pictures, surroundings))
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

    def carry_out(self, progress: Progress) -> dict[str, Any]:
        """Do the work; returns the metrics, which its report has written."""
        carry_out(self.work, progress)
        return self.metrics

    def complete(self, page: Page) -> None:
        """The page, the metrics, and all that ends the folder."""
        self.folder.complete(page, self.config, self.metrics, self.started)


def claim_folder(
    path: Path, name: str, text: str, kind: str, folders: Sequence[str] = ()
) -> FileLock:
    """Make a folder with `folders` in it, and write the file `name` that says what it holds.

    `kind` is a word for what it holds. A folder that holds the same already is taken as it is. The
    lock keeps other processes out as long as it is referred to.

    **Errors**: ConfigError where it holds anything else, is claimed, or cannot be made.
    """
    held = path / name
    try:
        path.mkdir(parents=True, exist_ok=True)
        refuse_foreign(path, name, text, kind)
        lock = FileLock(path / _LOCK, is_singleton=True)
        lock.acquire(timeout=0)
        write_whole(held, text)
        for folder in folders:
            (path / folder).mkdir(exist_ok=True)
        return lock
    except Timeout:
        raise ConfigError(
            f"--out {path}: another {kind} writes to it; wait for its end or give another folder"
        ) from None
    except WriteError:
        raise
    except OSError as error:
        raise ConfigError(f"--out {path}: cannot be made a folder ({error.strerror})") from None


def refuse_foreign(path: Path, name: str, text: str, kind: str) -> None:
    """ConfigError where an existing folder holds what `claim_folder` may not go on with."""
    held = path / name
    # Its lock and a partial file are all that is there where the first start was killed.
    foreign = any(p.name != _LOCK and p.suffix != ".partial" for p in path.iterdir())
    if held.exists():
        if read_regular(held) != text.encode("utf-8"):
            raise ConfigError(
                f"--out {path}: holds a {kind} of another configuration (see {held}); "
                "give another folder or delete this one"
            )
    elif foreign:
        raise ConfigError(f"--out {path}: is not empty and holds no {kind}; give a new folder")


def to_json(data: Any) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def as_record(kind: type[Record], data: Any) -> Record:
    """A dataclass from what a file holds of it, `asdict` undone."""
    return pydantic.TypeAdapter(kind).validate_python(data)
