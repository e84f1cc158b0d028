"""Experiment files of `kind: learned`: a camera, images to learn from, a network, its training."""

from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import section
from thincam_jax.commands.sections import (
    APERTURE,
    ApertureConfig,
    Length,
    LenslessConfig,
    Name,
    Section,
    SensorConfig,
    check_names,
)
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import NetworkOptions
from thincam_jax.learn.refocusing.scenes import SceneOptions
from thincam_jax.learn.refocusing.train import Lessons
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.studies.refocus import FocusRange

Count = Annotated[int, Field(ge=1, le=1_000_000)]


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
        for key, kind in (("path", "folder"), ("count", "drawn")):
            if (getattr(self, key) is None) == (self.kind == kind):
                verb = "needs" if self.kind == kind else "takes no"
                raise ValueError(f"kind {self.kind} {verb} '{key}'")
        return self


def check_sources(config: Any) -> None:
    """Sources have names of their own, and one of them trains."""
    check_names(config, "sources")
    if not any(source.use == "train" for source in config.sources):
        raise FieldError("none of them is of use 'train'; give one", "sources")


class ScenesConfig(section(SceneOptions)):
    """See `learn.refocusing.scenes.SceneOptions`; `side`: pixels of the images they are cut of."""

    side: Annotated[int, Field(ge=8, le=4096)] = 256


class NetworkConfig(section(NetworkOptions)):
    """See `learn.refocusing.NetworkOptions`."""


TRAINING = ("steps", "rate", "warm_up", "averaging", "check_every")
_LESSONS = ("batch", "pool", "judged")


class TrainingConfig(section(TrainingOptions, Lessons, only=(*TRAINING, *_LESSONS))):
    """See `learn.training.TrainingOptions`; `batch`, `pool`, `judged`: see `learn.Lessons`."""


class LearnedConfig(LenslessConfig):
    """A network that refocuses the captures of one camera."""

    pictured = "sources"
    kind: Literal["learned"]
    sensor: SensorConfig
    mask: ZonesConfig
    distance: Length
    focus: FocusConfig
    sources: Annotated[tuple[SourceConfig, ...], Field(min_length=1)]
    scenes: ScenesConfig = ScenesConfig()
    network: NetworkConfig = NetworkConfig()
    training: TrainingConfig = TrainingConfig()
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _sources_fit(self):
        check_sources(self)
        return self
