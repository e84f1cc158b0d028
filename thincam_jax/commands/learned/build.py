"""From an experiment file of `kind: learned` to its camera, network and lessons."""

import functools
import operator
from collections.abc import Callable
from typing import Any, TypeVar

import jax

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.learned.config import LearnedConfig, SourceConfig
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.sources import Source, drawn, photographs, samples
from thincam_jax.learn.refocusing.train import Lessons
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.lensless.camera import LenslessCamera

Found = TypeVar("Found")


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
    key = jax.random.key(config.seed)
    return RefocusNetwork.create(build_camera(config), config.network.build(), key=key)


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
