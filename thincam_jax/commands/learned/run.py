"""Training a refocusing network: from the file to its lessons, into a folder with a report."""

import functools
import operator
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.learned.config import LearnedConfig, SourceConfig
from thincam_jax.commands.report import Page, Part, Picture, pixels_of
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.result import RefocusTraining, finite, judge_training
from thincam_jax.learn.refocusing.sources import Source, drawn, photographs, samples
from thincam_jax.learn.refocusing.train import NETWORK, Lessons, train
from thincam_jax.learn.refocusing.unet import parameter_count
from thincam_jax.learn.training import TrainingOptions, TrainingProgress
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.plot import learned as plot
from thincam_jax.plot.refocus import animate_sweep, draw_sweep

Found = TypeVar("Found")

_SWEEP = "One capture, focused on the distance above each; one grey scale for all."
_SCENES = (
    "Where it is hatched, the network itself takes its distance to be wrong more often than right."
)


class TrainingFolder(RunFolder):
    """Files of one training, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `network.thincam`: the best network until now; `training-1.state` and so on: what
      `--resume` goes on from.
    - `figures/`, `environment.json`, `report.html` and, last, `training.json`.
    """

    kind, folders, result = "training", ("figures",), "training.json"
    others = (NETWORK,)


@dataclass(frozen=True)
class Ended:
    """How a training ended, in a line; the files of its network and its page."""

    line: str
    network: Path
    page: Path | None = None


def run_training(
    config: LearnedConfig,
    folder: TrainingFolder,
    callback: Callable[[TrainingProgress], object],
    *,
    resume: bool = False,
) -> Ended:
    """Train and report; writes training.json last.

    `resume`: go on from the state in the folder, to the same bits as without the interruption.

    **Errors**: ConfigError where a folder holds a training and `resume` is not asked for, or the
    other way round, or holds a damaged state.
    """
    started = time.time()
    check_resume(folder, resume)
    untrained, lessons = build_network(config), build_lessons(config)
    folder.claim(config)
    try:
        options = build_options(config)
        trained = train(untrained, lessons, options, folder=folder.path, callback=callback)
    except CheckpointError as error:
        raise ConfigError(str(error)) from None
    result = judge_training(trained, untrained, lessons.validation(trained.model, config.seed))
    state = trained.state
    metrics = {
        "name": config.name,
        "kind": config.kind,
        "seed": config.seed,
        "status": trained.status,
        **state.counts,
        "losses": [finite(loss) for loss in state.losses],
        "scores": [finite(score) for score in state.scores],
        "learned_numbers": parameter_count(result.network.weights),
        "linear": asdict(result.linear),
        "trained": asdict(result.scores),
        "images": lessons.manifest()["images"],
        "network": NETWORK,
    }
    folder.save_figure("loss", plot.draw_losses(state, config.training.check_every))
    folder.save_figure("scenes", plot.draw_scenes(result.network, result.batch, result.reading))
    sweep = result.sweep()
    folder.save_figure("sweep", draw_sweep(sweep))
    folder.write("figures/sweep.webp", animate_sweep(sweep))
    folder.complete(page(config, lessons, result), config, metrics, started)
    after, before = result.scores.focus_psnr_db, result.linear.focus_psnr_db
    line = f"focused images have {after:.2f} dB, the linear start {before:.2f} dB"
    path = folder.path
    return Ended(f"{trained.status}: {line}", path / NETWORK, path / "report.html")


def check_resume(folder: TrainingFolder, resume: bool) -> None:
    """**Errors**: ConfigError where the folder has a state and `resume` is not asked for, or the
    other way round."""
    begun = any(folder.path.glob("training*.state"))
    if begun and not resume:
        raise ConfigError(
            f"--out {folder.path}: holds a training; give --resume to go on with it, or another "
            "folder"
        )
    if resume and not begun:
        raise ConfigError(f"--resume: {folder.path} holds no training yet; leave it out")


def build_camera(config: LearnedConfig) -> RefocusCamera:
    """**Errors**: ConfigError, one line, for numbers that do not make a camera."""
    focus = config.focus
    try:
        camera = LenslessCamera(config.mask.build(), config.sensor.build(), config.distance)
        return RefocusCamera(
            camera,
            config.wavelength,
            field_shape=focus.shape,
            near=focus.nearest,
            far=focus.farthest,
            planes=focus.planes,
            pupil=focus.pupil,
            model=config.model,
        )
    except (ValueError, TypeError) as error:
        raise ConfigError(f"mask, sensor or focus: {error}") from None


def build_network(config: LearnedConfig) -> RefocusNetwork:
    """Untrained, by the seed of the file."""
    return RefocusNetwork.create(build_camera(config), config.network.build(), key=config.seed)


def build_lessons(config: LearnedConfig) -> Lessons:
    """**Errors**: ConfigError, one line for each source that cannot be read."""
    of_use: dict[str, list[Source]] = {"train": [], "judge": []}
    images = read_sources(config, functools.partial(_read, side=config.scenes.side))
    for source, read in zip(config.sources, images, strict=True):
        of_use[source.use].append(read)
    train, judge = (functools.reduce(operator.add, s) if s else None for s in of_use.values())
    assert train is not None  # the sections are checked
    scenes = config.scenes.build()
    return config.training.build(Lessons, source=train, scenes=scenes, held_out=judge)


def read_sources(config: Any, read: Callable[[Any], Found]) -> list[Found]:
    """The images of every source of a file, by a function of its section.

    **Errors**: ConfigError, one line for each source that cannot be read.
    """
    found, faults = [], []
    for number, source in enumerate(config.sources):
        try:
            found.append(read(source))
        except (ValueError, OSError) as error:
            place = config.place_of("sources", number)
            faults.append(f"{place}sources[{number}]: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return found


def build_options(config: Any) -> TrainingOptions:
    """Length and rate of a training."""
    return config.training.build(TrainingOptions, seed=config.seed)


def _read(source: SourceConfig, side: int) -> Source:
    if source.kind == "drawn":
        assert source.count is not None  # the section is checked
        return drawn(source.seed, source.count, side)
    if source.kind == "samples":
        return samples(side)
    assert source.path is not None
    return photographs(source.path, side, licence=source.licence)


def page(config: LearnedConfig, lessons: Lessons, result: RefocusTraining) -> Page:
    """The page of a finished training."""
    mask, focus, trained = config.mask, config.focus, result.trained
    state, numbers = trained.state, parameter_count(result.network.weights)
    lead = (
        f"A network of {numbers} numbers that refocuses captures of one camera: "
        f"{pixels_of(config.sensor).lower()}, zone aperture of {mask.width:g} mm with β = "
        f"{mask.beta:g} rad/mm² at d = {config.distance:g} mm, λ = {config.wavelength * 1e6:g} nm; "
        f"objects at {focus.nearest:g} to {focus.farthest:g} mm. The file is "
        f"`{NETWORK}`."
    )
    scores = (
        result.table(),
        "Of the scenes of the checks, each with its own noise and commanded distance.",
    )
    sweep = (
        Picture("sweep.png", "Contact sheet of the sweep", _SWEEP),
        Picture("sweep.webp", "Animation of the sweep"),
    )
    training = (
        f"{state.step} steps, {state.skipped} skipped, {state.retreats} times back at half the "
        f"rate: {trained.status}.",
        Picture("loss.png", "Loss"),
    )
    scenes = Picture("scenes.png", "Scenes and what the network makes of them", _SCENES)
    warnings = ()
    if trained.status == "diverged":
        warnings = ("training met NaN again and again; this is its best until then",)
    parts = (
        Part("Scores", scores),
        Part("Sweep", sweep),
        Part("Scenes", (scenes,)),
        Part("Training", training),
        Part("Images", (lessons.images_table(), *config.notes)),
    )
    return Page((lead,), parts, command="train", warnings=warnings)
