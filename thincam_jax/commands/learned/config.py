"""Experiment files of `kind: learned`: a camera, images to learn from, a network, its training."""

from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax.commands.refocus.config import RangeConfig
from thincam_jax.commands.sections import (
    ApertureConfig,
    Curvature,
    Length,
    LenslessConfig,
    Name,
    Section,
    SensorConfig,
    check_names,
    misfit,
)

Chance = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Widths = Annotated[tuple[Annotated[int, Field(ge=1, le=1024)], ...], Field(min_length=1)]
Interval = tuple[float, float]


class ZonesConfig(ApertureConfig):
    """The Fresnel zone aperture."""

    beta: Curvature


class FocusConfig(RangeConfig):
    """Images that are to be had: see `learn.refocusing.RefocusCamera`."""

    shape: tuple[Count, Count]
    planes: Annotated[int, Field(ge=2, le=64)] = 8
    pupil: Length | None = None


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
        raise misfit("none of them is of use 'train'; give one", "sources")


class ScenesConfig(Section):
    """See `learn.refocusing.scenes.SceneOptions`; `side`: pixels of the images they are cut of."""

    layers: tuple[Chance, Chance, Chance] = (0.35, 0.45, 0.2)
    dark: Chance = 0.1
    relief: Chance = 0.3
    depth: Chance = 0.12
    snr_db: Interval = (20.0, 45.0)
    poisson: Chance = 0.2
    electrons: Interval = (50.0, 20000.0)
    distances: tuple[Length, ...] | None = None
    side: Annotated[int, Field(ge=8, le=4096)] = 256


class NetworkConfig(Section):
    """See `learn.refocusing.NetworkOptions`."""

    steps: Annotated[int, Field(ge=1, le=20)] = 2
    widths: Widths = (40, 44, 44, 44, 40)


class TrainingConfig(Section):
    """See `learn.training.TrainingOptions`; `batch`, `pool`, `judged`: see `learn.Lessons`."""

    steps: Count = 2000
    batch: Annotated[int, Field(ge=1, le=1024)] = 2
    pool: Count = 256
    rate: Annotated[float, Field(gt=0)] = 1e-3
    warm_up: Annotated[int, Field(ge=0)] = 50
    averaging: Annotated[float, Field(ge=0, lt=1)] = 0.99
    check_every: Count = 100
    judged: Annotated[int, Field(ge=1, le=1000)] = 4


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
