"""Experiment files of `kind: trained`: a camera, pictures or pairs, and a training in a folder."""

import functools
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax._core.table import Table
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.evaluate.config import EvaluationConfig
from thincam_jax.commands.evaluate.pair import opened, prepared_pair
from thincam_jax.commands.reconstruct.jobs import Inputs
from thincam_jax.commands.reconstruct.options import Sources
from thincam_jax.commands.report import Page, Part, Picture
from thincam_jax.commands.schema import Section, section
from thincam_jax.learn import trained_lessons
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.commands.denoiser import PicturesConfig, read_pictures
from thincam_jax.learn.commands.training import (
    TRAINING,
    Ended,
    InFolder,
    LearningConfig,
    images_before,
)
from thincam_jax.learn.imperfections import Imperfections
from thincam_jax.learn.plot import draw_losses
from thincam_jax.learn.sources import as_json, from_json
from thincam_jax.learn.trained import TrainedOptions, TrainedReconstruction, training_record
from thincam_jax.learn.trained_lessons import CameraLessons, PairLessons
from thincam_jax.learn.trained_training import (
    NETWORK,
    ReconstructionLessons,
    gains,
    train_reconstruction,
)
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.learn.unet import parameter_count
from thincam_jax.measured import MeasurementError, Preparation
from thincam_jax.measured.layouts import open_pairs

# At a rate of 0.0015 all units of the network died within 600 steps.
_USUAL = {
    "steps": 4000,
    "rate": 4e-4,
    "warm_up": 200,
    "averaging": 0.995,
    "check_every": 200,
    "falling": 0.8,
}
_LESSONS = ("fitted", "pool", "judged", "batch", "crop")


class PsfConfig(Section):
    """Measured PSF, and how it and the captures are prepared: see `thincam reconstruct`."""

    path: str
    background: float | None = None
    bits: int | None = None
    preparation: Preparation = Preparation()

    def sources(self) -> Sources:
        return Sources(Path(self.path), self.background, None, None, self.bits, self.preparation)


class PairsConfig(Section):
    """Captures with truths, as of `thincam evaluate`; the last `judged` judge the network.

    `split`: by default "train" where there is one.
    """

    path: str
    split: str | None = None
    truth: Literal["linear", "srgb"] | None = None
    judged: Annotated[int, Field(ge=1)] = 4


class ImperfectionsConfig(section(Imperfections)):
    """See `learn.imperfections.Imperfections`."""


class TrainedNetworkConfig(section(TrainedOptions)):
    """See `learn.trained.TrainedOptions`."""


class TrainedTrainingConfig(
    section(
        TrainingOptions,
        ReconstructionLessons,
        only=(*TRAINING, "falling", *_LESSONS),
        defaults=_USUAL,
    )
):
    """See `learn.training.TrainingOptions` and `learn.trained_training.ReconstructionLessons`."""


class TrainedConfig(LearningConfig):
    """A reconstruction trained for one camera; `start`: the file of one to go on from."""

    with_path: ClassVar[tuple[str, ...]] = ("psf", "pairs")
    kind: Literal["trained"]
    psf: PsfConfig
    sources: Annotated[tuple[PicturesConfig, ...], Field(min_length=1)]
    pairs: PairsConfig | None = None
    start: str | None = None
    faults: ImperfectionsConfig = ImperfectionsConfig()
    network: TrainedNetworkConfig = TrainedNetworkConfig()
    training: TrainedTrainingConfig = TrainedTrainingConfig()
    notes: tuple[str, ...] = ()


def run_trained(config: TrainedConfig, place: InFolder) -> Ended:
    """Train and report; writes training.json last. **Errors**: as of `InFolder`."""
    started = time.time()
    place.check(config)
    folder, lessons = place.folder, build_lessons(config)
    untrained = build_untrained(config, lessons)
    known = images_before(config, lambda path: from_json(training_record(path).get("images", {})))
    lessons = replace(lessons, images=lessons.images | known)
    done = place.train(config, train_reconstruction, untrained, lessons)
    state, rows = done.state, gains(done.model, lessons, config.seed)
    before, after = (float(np.mean(part)) for part in zip(*rows, strict=True))
    finding = f"{after:.2f} dB on captures held out, {after - before:+.2f} to its physics step"
    metrics = {
        "name": config.name,
        "kind": config.kind,
        "status": done.status,
        **state.counts,
        "scores": [finite(score) for score in state.scores],
        "psnr_db": {
            "physics": [finite(before) for before, _ in rows],
            "trained": [finite(after) for _, after in rows],
        },
        "learned_numbers": parameter_count(done.model),
        "images": as_json(lessons.images),
        "network": NETWORK,
    }
    folder.save_figure("loss", draw_losses(state, config.training.check_every))
    folder.complete(_page(config, lessons, rows, finding), config, metrics, started)
    path = folder.path
    return Ended(f"{done.status}: {finding}", path / NETWORK, path / "report.html")


def build_untrained(config: TrainedConfig, lessons: ReconstructionLessons) -> TrainedReconstruction:
    """New by the seed of the file, or the one that training starts from.

    **Errors**: ConfigError, one line, for a file of no use, of another size or camera.
    """
    options, psf = config.network.build(), lessons.camera.psf
    if config.start is None:
        try:
            return TrainedReconstruction.create(options, psf, key=config.seed)
        except ValueError as error:
            raise ConfigError(f"{config.place_of('network')}network: {error}") from None
    fault = f"{config.place_of('start')}start: "
    try:
        known = TrainedReconstruction.load(config.start)
        known.check_camera(psf)
    except FileNotFoundError:
        raise ConfigError(f"{fault}{config.start}: is missing; give a network's file") from None
    except (CheckpointError, OSError, ValueError) as error:
        raise ConfigError(f"{fault}{error}") from None
    if known.options != options:
        has = f"has {known.options}"
        raise ConfigError(f"{fault}{config.start} {has}; give these in the section network")
    return known


def build_lessons(config: TrainedConfig) -> ReconstructionLessons:
    """**Errors**: ConfigError, one line for each file that cannot be read."""
    train, judge = read_pictures(config, trained_lessons)
    judge = judge or train
    try:
        ready = Inputs(config.psf.sources()).prepare(Path(config.psf.path))
    except (MeasurementError, OSError) as error:
        raise ConfigError(f"{config.place_of('psf')}psf: {error}") from None
    rows, columns = ready.capture.shape[-2:]
    faults = config.faults.build()
    made = [CameraLessons(ready.psf, (rows, columns), p, faults) for p in (train, judge)]
    images = {"trained on": train.manifest, "judged on": judge.manifest}
    parts: dict[str, Any] = {"judge": made[1]}
    if config.pairs is not None:
        parts["train"], parts["judge"] = pairs = _pairs(config)
        known = zip(("trained on", "judged on"), pairs, strict=True)
        images = {"fitted on": images["trained on"], **{use: one.manifest for use, one in known}}
    lessons = {"camera": made[0], "images": images, **parts}
    try:
        return config.training.build(ReconstructionLessons, **lessons)
    except FieldError as error:
        place = config.place_of("training", error.field)
        raise ConfigError(f"{place}training.{error}") from None


def _pairs(config: TrainedConfig) -> tuple[PairLessons, PairLessons]:
    """Pairs that train, and those that judge."""
    given, psf = config.pairs, config.psf
    assert given is not None
    fault = f"{config.place_of('pairs')}pairs: "
    try:
        found = open_pairs(Path(given.path), given.split or "all", bits=psf.bits)
        asked = EvaluationConfig(
            name=config.name,
            title="",
            path=given.path,
            split=given.split or ("train" if "train" in found.splits else "all"),
            psf=psf.path,
            background=None if psf.background is None else str(psf.background),
            bits=psf.bits,
            preparation=psf.preparation,
            truth=given.truth,
        ).model_dump_json()
        _, pairs = opened(asked)
    except (MeasurementError, OSError) as error:
        raise ConfigError(f"{fault}{error}") from None
    kept = len(pairs) - given.judged
    if kept < 1:
        raise ConfigError(f"{fault}judged = {given.judged} of {len(pairs)} pairs; give fewer")
    ready = functools.partial(_ready, asked)
    return PairLessons(pairs, ready, 0, kept), PairLessons(pairs, ready, kept, given.judged)


def _ready(asked: str, pair: Any) -> Any:
    return prepared_pair(asked, pair)[0]


def finite(value: Any) -> float | None:
    """Number to four decimals; None where it is not finite, which JSON has no number for."""
    return round(float(value), 4) if np.isfinite(value) else None


def _page(
    config: TrainedConfig,
    lessons: ReconstructionLessons,
    rows: Sequence[tuple[float, float]],
    finding: str,
) -> Page:
    """The page of a finished training."""
    size = "×".join(map(str, lessons.camera.sensor))
    lead = f"A reconstruction trained for captures of {size} pixels by {config.psf.path}."
    headings = "capture held out", "physics step, dB", "trained, dB"
    scores = [(str(number), *pair) for number, pair in enumerate(rows)]
    images = [(e.name, use, e.licence) for use, all_ in lessons.images.items() for e in all_]
    parts = (
        Part("Scores", (Table(headings, scores, digits=(2, 2)),)),
        Part("Training", (Picture("loss.png", "Loss of the training"),)),
        Part("Images", (Table(("image", "use", "licence"), images), *config.notes)),
    )
    return Page((lead,), parts, "train", (), f"After training: {finding}.")
