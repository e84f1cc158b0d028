"""Trainings in a folder, and the sources of their images, of all kinds that learn."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.schema import Section
from thincam_jax.commands.sections import ExperimentConfig, Name, check_keys, check_names
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.sources import Entry
from thincam_jax.learn.training import NETWORK, Trained, TrainingOptions, TrainingProgress

Count = Annotated[int, Field(ge=1, le=1_000_000)]
TRAINING = ("steps", "rate", "warm_up", "averaging", "check_every")


class SourceConfig(Section):
    """Images that scenes are drawn of: a folder's, scikit-image's own, or drawn ones.

    `use`: to train, or to judge the network at each check, by images that no step sees.
    """

    name: Name
    kind: Literal["folder", "samples", "drawn"]
    use: Literal["train", "judge"] = "train"
    path: str | None = None
    licence: str = ""
    count: Count | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_keys(self, path="folder", count="drawn")
        return self

    def images(self, maker: Any) -> Any:
        """Images by a module's functions, one for each kind."""
        if self.kind == "drawn":
            return maker.drawn(self.seed, self.count)
        if self.kind == "samples":
            return maker.samples()
        return maker.photographs(self.path, licence=self.licence)


class LearningConfig(ExperimentConfig):
    """Files with `sources` of images, which have names of their own, and of which one trains."""

    pictured = "sources"

    @pydantic.model_validator(mode="after")
    def _sources_fit(self):
        check_names(self, "sources")
        if not any(source.use == "train" for source in getattr(self, self.pictured)):
            raise FieldError("none of them is of use 'train'; give one", "sources")
        return self


class TrainingFolder(RunFolder):
    """Files of one training, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `network.thincam`: the best network until now; `training-1.state` and so on: what
      `--resume` goes on from.
    - `figures/`, `environment.json`, `report.html` and, last, `training.json`.
    """

    kind, folders, result = "training", ("figures",), "training.json"
    others = (NETWORK,)


def images_before(
    config: Any, images_of: Callable[[Any], dict[str, tuple[Entry, ...]]]
) -> dict[str, tuple[Entry, ...]]:
    """Entries of the pictures of the network that a training starts from, by their use before.

    **Errors**: ConfigError for a file that does not say them.
    """
    try:
        found = {} if config.start is None else images_of(config.start)
    except (CheckpointError, TypeError) as error:
        raise ConfigError(f"{config.place_of('start')}start: {error}") from None
    return {f"{use}, before": entries for use, entries in found.items()}


@dataclass(frozen=True)
class Ended:
    """End of a training, in a line; the files of its network and its page."""

    line: str
    network: Path
    page: Path | None = None


@dataclass(frozen=True)
class InFolder:
    """A training in a folder: what is called at each check, and whether it is to go on.

    - `resume`: from the state in the folder, to the same bits as without the interruption.
    """

    folder: TrainingFolder
    callback: Callable[[TrainingProgress], object]
    resume: bool = False

    def check(self, config: Any) -> None:
        """**Errors**: ConfigError where the folder has a state and `resume` is False, or
        the other way round, and where the state came from other inputs."""
        path = self.folder.path
        begun = any(path.glob("training*.state"))
        if begun and not self.resume:
            raise ConfigError(
                f"--out {path}: holds a training; give --resume to go on with it, or another folder"
            )
        if self.resume and not begun:
            raise ConfigError(f"--resume: {path} holds no training yet; leave it out")
        if begun and (changed := self.folder.changed(config)):
            text = f"began with another {changed[0]}; restore that, or begin in another folder"
            raise ConfigError(f"--resume: the training in {path} {text}")

    def train(
        self, config: Any, train: Callable[..., Trained], network: Any, lessons: Any
    ) -> Trained:
        """Train; **errors**: ConfigError for a folder of something else or a damaged state."""
        self.folder.claim(config)
        options = config.training.build(TrainingOptions, seed=config.seed)
        place = {"folder": self.folder.path, "callback": self.callback}
        try:
            return train(network, lessons, options, **place)
        except CheckpointError as error:
            raise ConfigError(str(error)) from None


def lessons(asked: Any, setup: Any) -> Iterator[str]:
    """Steps and checks of a training."""
    training = asked.training
    checks = training.steps // training.check_every
    yield (
        f"training: {training.steps} steps of {training.batch} examples, {checks} checks on "
        f"{training.judged} batches"
    )
