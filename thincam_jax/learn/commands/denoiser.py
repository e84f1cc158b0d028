"""Experiment files of `kind: denoiser`: pictures, a network and its training in a folder."""

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import to_json
from thincam_jax.commands.schema import section
from thincam_jax.learn import sources, unet
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.commands.training import (
    TRAINING,
    Ended,
    InFolder,
    LearningConfig,
    SourceConfig,
    images_before,
)
from thincam_jax.learn.denoiser import pictures
from thincam_jax.learn.denoiser.network import (
    Denoiser,
    DenoiserOptions,
    DenoisingUNet,
    create,
    network_card,
)
from thincam_jax.learn.denoiser.pictures import Pictures, united
from thincam_jax.learn.denoiser.train import NETWORK, DenoisingLessons, train_denoiser
from thincam_jax.learn.plot import draw_losses
from thincam_jax.learn.training import TrainingOptions


class PicturesConfig(SourceConfig):
    """Pictures of a source; those `held_out`, by their names, judge the network."""

    held_out: tuple[str, ...] = ()


_USUAL = {"steps": 20000, "warm_up": 100, "falling": 0.5, "averaging": 0.999, "check_every": 500}
_TRAINING = {
    "only": (*TRAINING, "falling", "batch", "crop", "judged", "cameras"),
    "defaults": _USUAL,
}


class DenoiserNetworkConfig(section(DenoiserOptions)):
    """See `learn.denoiser.network.DenoiserOptions`."""


class DenoiserTrainingConfig(section(TrainingOptions, DenoisingLessons, **_TRAINING)):
    """See `learn.training.TrainingOptions` and `learn.denoiser.train.DenoisingLessons`."""


class DenoiserConfig(LearningConfig):
    """A denoiser; `start`: a network's file, or "shipped", that training goes on from."""

    kind: Literal["denoiser"]
    sources: Annotated[tuple[PicturesConfig, ...], Field(min_length=1)]
    start: str | None = None
    network: DenoiserNetworkConfig = DenoiserNetworkConfig()
    training: DenoiserTrainingConfig = DenoiserTrainingConfig()
    notes: tuple[str, ...] = ()


def run_denoiser(config: DenoiserConfig, place: InFolder) -> Ended:
    """Train a denoiser; writes training.json last. **Errors**: as of `InFolder`."""
    place.check(config)
    folder, network, lessons = place.folder, build_network(config), build_lessons(config)
    known = images_before(config, lambda path: network_card(path).images)
    lessons = replace(lessons, before=known)
    trained = place.train(config, train_denoiser, network, lessons)
    state = trained.state
    result = {
        "name": config.name,
        "kind": config.kind,
        "status": trained.status,
        **state.counts,
        "loss": float(np.nanmin(state.scores)),
        "scores": [None if score != score else round(float(score), 5) for score in state.scores],
        "learned_numbers": unet.parameter_count(network),
        "images": sources.as_json(lessons.images),
        "network": NETWORK,
    }
    folder.save_figure("loss", draw_losses(state, config.training.check_every))
    folder.write(folder.result, to_json(result))
    line = f"{trained.status}: loss {result['loss']:.4f} on pictures held out"
    return Ended(line, folder.path / NETWORK)


def build_network(config: DenoiserConfig) -> DenoisingUNet:
    """New by the seed of the file, or the one that training starts from.

    **Errors**: ConfigError, one line, for a file of no use or of another size.
    """
    options = config.network.build()
    if config.start is None:
        return create(options, key=config.seed)
    try:
        network = Denoiser.load(config.start).network
    except FileNotFoundError:
        fault = f"{config.start}: is missing; give a network's file, or 'shipped'"
        raise ConfigError(f"{config.place_of('start')}start: {fault}") from None
    except (CheckpointError, OSError) as error:
        raise ConfigError(f"{config.place_of('start')}start: {error}") from None
    if network.shape != (options.widths, options.blocks):
        widths, blocks = network.shape
        raise ConfigError(
            f"{config.place_of('start')}start: {config.start} has widths {list(widths)} and blocks "
            f"{list(blocks)}; give these in the section network"
        )
    return network


def build_lessons(config: DenoiserConfig) -> DenoisingLessons:
    """**Errors**: ConfigError, one line for each source that cannot be read."""
    train, judge = read_pictures(config, pictures)
    return config.training.build(DenoisingLessons, pictures=train, held_out=judge)


def read_pictures(config: Any, maker: Any) -> tuple[Pictures, Pictures | None]:
    """Pictures of all sources to train on, by functions of a module, and those that judge.

    **Errors**: ConfigError, one line for each source that cannot be read.
    """
    train: list[Pictures] = []
    judge: list[Pictures] = []

    def read(source: PicturesConfig) -> tuple[list[Pictures], list[Pictures]]:
        images = source.images(maker)
        named = images if isinstance(images, dict) else {source.name: images}
        return pictures.split(named, source.held_out)

    read_all = config.read_all("sources", read)
    for source, (kept, held_out) in zip(config.sources, read_all, strict=True):
        (train if source.use == "train" else judge).extend(kept)
        judge.extend(held_out)
    if not train:
        place = config.place_of("sources")
        raise ConfigError(f"{place}sources: none is left to train on; give one")
    return united(train), united(judge) if judge else None
