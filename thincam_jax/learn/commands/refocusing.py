"""Experiments of `kind: learned`: the file, the training of a refocusing network, its report."""

import functools
import operator
import time
from dataclasses import asdict
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.mask import APERTURE, ApertureConfig
from thincam_jax.commands.report import Page, Part, Picture, pixels_of
from thincam_jax.commands.schema import Length, section
from thincam_jax.commands.sections import LenslessConfig, SensorConfig
from thincam_jax.learn import plot
from thincam_jax.learn.commands.training import (
    TRAINING,
    Count,
    Ended,
    InFolder,
    LearningConfig,
    SourceConfig,
)
from thincam_jax.learn.refocusing import sources
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.learned import RefocusTraining, finite, judge_training
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.scenes import SceneOptions
from thincam_jax.learn.refocusing.train import NETWORK, Lessons, train
from thincam_jax.learn.refocusing.unet import parameter_count
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.plot.refocus import animate_sweep, draw_sweep
from thincam_jax.studies.refocus import FocusRange

_SWEEP = "One capture, focused on the distance above each; one grey scale for all."
_PAIRS = (
    "pictures on a monitor have no depth, which this network learns; give pairs to 'kind: trained'"
)
_SCENES = (
    "Where it is hatched, the network itself takes its distance to be wrong more often than right."
)


class ZonesConfig(section(FresnelZoneAperture, only=("beta", *APERTURE)), ApertureConfig):
    """The Fresnel zone aperture."""


class FocusConfig(
    section(FocusRange, RefocusCamera, only=("nearest", "farthest", "planes", "pupil"))
):
    """Images that are to be had: see `learn.refocusing.RefocusCamera`."""

    shape: tuple[Count, Count]

    @pydantic.model_validator(mode="after")
    def _ordered(self):
        FocusRange("", self.nearest, self.farthest)
        return self


class ScenesConfig(section(SceneOptions)):
    """See `learn.refocusing.scenes.SceneOptions`; `side`: pixels of the images they are cut of."""

    side: Annotated[int, Field(ge=8, le=4096)] = 256


class NetworkConfig(section(NetworkOptions)):
    """See `learn.refocusing.NetworkOptions`."""


_LESSONS = ("batch", "pool", "judged")


class RefocusTrainingConfig(section(TrainingOptions, Lessons, only=(*TRAINING, *_LESSONS))):
    """See `learn.training.TrainingOptions`; `batch`, `pool`, `judged`: see `learn.Lessons`."""


class LearnedConfig(LenslessConfig, LearningConfig):
    """A network that refocuses the captures of one camera."""

    kind: Literal["learned"]
    sensor: SensorConfig
    mask: ZonesConfig
    distance: Length
    focus: FocusConfig
    sources: Annotated[tuple[SourceConfig, ...], Field(min_length=1)]
    scenes: ScenesConfig = ScenesConfig()
    network: NetworkConfig = NetworkConfig()
    training: RefocusTrainingConfig = RefocusTrainingConfig()
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _without_pairs(cls, given: Any):
        """The file; docs/decisions/pairs_of_a_monitor.md says why it takes no pairs."""
        entries = given.get("sources") if isinstance(given, dict) else ()
        for number, one in enumerate(entries if isinstance(entries, list | tuple) else ()):
            if isinstance(one, dict) and one.get("kind") == "pairs":
                raise FieldError(_PAIRS, "sources", number, "kind")
        if entries == "pairs":
            raise FieldError(_PAIRS, "sources")
        return given


def run_training(config: LearnedConfig, place: InFolder) -> Ended:
    """Train and report; writes training.json last. **Errors**: as of `InFolder`."""
    started, folder = time.time(), place.folder
    place.check(config)
    untrained, lessons = build_network(config), build_lessons(config)
    trained = place.train(config, train, untrained, lessons)
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
        "images": sources.as_json(lessons.images),
        "network": NETWORK,
    }
    folder.save_figure("loss", plot.draw_losses(state, config.training.check_every))
    folder.save_figure("scenes", plot.draw_scenes(result.network, result.batch, result.reading))
    sweep = result.sweep()
    folder.save_figure("sweep", draw_sweep(sweep))
    folder.write("figures/sweep.webp", animate_sweep(sweep))
    folder.complete(page(config, lessons, result), config, metrics, started)
    path = folder.path
    return Ended(f"{trained.status}: {result.finding()}", path / NETWORK, path / "report.html")


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
    of_use: dict[str, list[sources.Source]] = {"train": [], "judge": []}
    side = config.scenes.side
    images = config.read_all("sources", lambda source: source.images(sources, side))
    for source, read in zip(config.sources, images, strict=True):
        of_use[source.use].append(read)
    train, judge = (functools.reduce(operator.add, s) if s else None for s in of_use.values())
    assert train is not None  # the sections are checked
    scenes = config.scenes.build()
    return config.training.build(Lessons, source=train, scenes=scenes, held_out=judge)


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
        Picture("sweep.png", "One capture, focused on distances", _SWEEP),
        Picture("sweep.webp", "One capture, focused nearer and farther"),
    )
    training = (
        f"{state.step} steps, {state.skipped} skipped, {state.retreats} times back at half the "
        f"rate: {trained.status}.",
        Picture("loss.png", "Loss of the training"),
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
    return Page((lead,), parts, "train", warnings, f"After training, {result.finding()}.")
