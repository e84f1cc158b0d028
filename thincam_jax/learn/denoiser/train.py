"""Training of a denoiser on drawn crops of pictures, in a folder that it goes on from."""

import dataclasses
import functools
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp

from thincam_jax._core.quantity import FieldError, check_fields, whole
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.denoiser.network import Denoiser, DenoisingUNet, network_card
from thincam_jax.learn.denoiser.pictures import TILE, Pictures
from thincam_jax.learn.denoiser.reconstructions import (
    draw_cameras,
    draw_crops,
    draw_reconstructions,
    loss,
    reconstruction_loss,
)
from thincam_jax.learn.sources import Entry, as_json
from thincam_jax.learn.training import (
    NETWORK,
    Task,
    Trained,
    TrainingFiles,
    TrainingOptions,
    TrainingProgress,
    TrainingState,
    train_model,
)

STATE = "training.state"
# Of the seed's key: the crops that judge a network.
_JUDGED = 2**31


@dataclasses.dataclass(frozen=True, eq=False)
class DenoisingLessons:
    """Training set of a denoiser.

    - `pictures`: pictures of each step; `held_out`: those that judge the network, which no step
      sees; by default the same.
    - `batch`: crops of a step; `crop`: pixels of their sides; `judged`: batches of a check.
    - `cameras`: number of drawn cameras, behind which the network learns inside the steps of
      `PlugAndPlay`, too; 0: none.
    - `before`: entries of the pictures of the network that training starts from, by their use.
    """

    pictures: Pictures
    held_out: Pictures | None = None
    batch: Annotated[int, whole(1, 1024)] = 16
    crop: Annotated[int, whole(1, TILE)] = 64
    judged: Annotated[int, whole(1, 1000)] = 16
    cameras: Annotated[int, whole(0, 1000)] = 0
    before: dict[str, tuple[Entry, ...]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        check_fields(self)
        side = self.pictures.tiles.shape[1]
        if self.crop > side:
            message = f"crop = {self.crop}; give 1 to {side} pixels, the side of a tile"
            raise FieldError(message, "crop")

    def task(self, seed: int) -> Task:
        """Crops to be drawn, and those that judge; with cameras also their captures."""
        draw, learned_by = draw_crops, loss
        if self.cameras:
            cameras = draw_cameras(seed, self.cameras, self.crop)
            draw, learned_by = functools.partial(draw_reconstructions, cameras), reconstruction_loss
        judges = self.pictures if self.held_out is None else self.held_out
        tiles, key = jnp.asarray(judges.tiles), jax.random.fold_in(jax.random.key(seed), _JUDGED)
        keys = jax.random.split(key, self.judged)
        judged = [draw(tiles, self.batch, self.crop, one) for one in keys]
        drawn = functools.partial(draw, jnp.asarray(self.pictures.tiles), self.batch, self.crop)
        return Task(drawn, learned_by, judged)

    @property
    def images(self) -> dict[str, tuple[Entry, ...]]:
        """Entries of all pictures by their use."""
        uses = {"trained on": self.pictures, "judged on": self.held_out}
        own = {use: one.manifest for use, one in uses.items() if one is not None}
        return own | self.before


def train_denoiser(
    network: DenoisingUNet,
    lessons: DenoisingLessons,
    options: TrainingOptions,
    *,
    folder: str | os.PathLike[str] | None = None,
    callback: Callable[[TrainingProgress], object] | None = None,
) -> Trained:
    """Train a network, new or one that was trained before.

    **Arguments**

    - `folder`: holds `network.thincam` and `training.state`; see `TrainingFiles`.

    **Errors**: CheckpointError, one line, for a state that is damaged or of another training.
    """
    network, train = jax.tree.map(jnp.asarray, network), train_model
    task = lessons.task(options.seed)
    if folder is not None:
        widths, blocks = network.shape
        record = _described(lessons, options)
        settings = {"widths": widths, "blocks": blocks, **record}
        state, path = Path(folder) / STATE, Path(folder) / NETWORK
        before = (_seconds(path) if state.exists() else 0.0) - time.process_time()
        save = functools.partial(_save, path, record, before)
        train = TrainingFiles(state, settings, save).train
    return train(task, network, options, callback=callback)


def _described(lessons: DenoisingLessons, options: TrainingOptions) -> dict[str, Any]:
    """The pictures with their sums and licences, the crops and the options as JSON."""
    crops = {name: getattr(lessons, name) for name in ("batch", "crop", "judged", "cameras")}
    described = {"training": dataclasses.asdict(options), **crops}
    return {"images": as_json(lessons.images), **described}


def _seconds(path: Path) -> float:
    """CPU time that a network was trained for."""
    try:
        return network_card(path).cpu_seconds
    except (OSError, CheckpointError):
        return 0.0


def _save(path: Path, record, before: float, state: TrainingState) -> None:
    """Write the best network with its training record."""
    seconds = round(before + time.process_time(), 1)
    Denoiser(state.best).save(path, {**record, **state.record, "cpu_seconds": seconds})
