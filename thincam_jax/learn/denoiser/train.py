"""Training of a denoiser on drawn crops of pictures, in a folder that it goes on from."""

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.quantity import FieldError, check_fields, whole
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.denoiser.network import LEAST, MOST, denoised, network_card, save_network
from thincam_jax.learn.denoiser.pictures import TILE, Pictures
from thincam_jax.learn.denoiser.unet import DenoisingUNet
from thincam_jax.learn.refocusing.sources import Entry, as_json
from thincam_jax.learn.training import (
    Task,
    Trained,
    TrainingOptions,
    TrainingProgress,
    TrainingState,
    read_state,
    train_model,
    write_state,
)

NETWORK, STATE = "network.thincam", "training.state"
# Of the seed's key: the crops that judge a network.
_JUDGED = 2**31
# ln of the exponents and factors that change the contrast of a crop.
_GAMMA, _GAIN = (-0.9, 0.3), (-0.8, 0.5)
# Standard deviation of an offset subtracted from a crop beside its mean: in a large image, local
# means differ from the mean of the whole.
_OFFSET = 0.15
# Added to MSE/σ²: the root's slope stays finite.
_LEAST_ERROR = 1e-4


class Crops(eqx.Module):
    """Noisy crops and what is to be found in them; see `denoised` for `centre`."""

    clean: Float[Array, "image y x"]
    noisy: Float[Array, "image y x"]
    sigma: Float[Array, " image"]
    centre: Float[Array, " image"]


@dataclasses.dataclass(frozen=True, eq=False)
class DenoisingLessons:
    """Training set of a denoiser.

    - `pictures`: of each step; `held_out`: those that judge the network, which no step sees;
      by default the same.
    - `batch`: crops of a step; `crop`: pixels of their sides; `judged`: batches of a check.
    """

    pictures: Pictures
    held_out: Pictures | None = None
    batch: Annotated[int, whole(1, 1024)] = 16
    crop: Annotated[int, whole(1, TILE)] = 64
    judged: Annotated[int, whole(1, 1000)] = 16

    def __post_init__(self):
        check_fields(self)
        side = self.pictures.tiles.shape[1]
        if self.crop > side:
            message = f"crop = {self.crop}; give 1 to {side} pixels, the side of a tile"
            raise FieldError(message, "crop")

    def task(self, seed: int) -> Task:
        """Crops to be drawn, and those that judge."""
        draw = functools.partial(
            draw_crops, jnp.asarray(self.pictures.tiles), self.batch, self.crop
        )
        judges = self.pictures if self.held_out is None else self.held_out
        tiles, key = jnp.asarray(judges.tiles), jax.random.fold_in(jax.random.key(seed), _JUDGED)
        keys = jax.random.split(key, self.judged)
        judged = [draw_crops(tiles, self.batch, self.crop, one) for one in keys]
        return Task(draw, loss, judged)

    @property
    def images(self) -> dict[str, tuple[Entry, ...]]:
        """Entries of all pictures by their use."""
        uses = {"trained on": self.pictures, "judged on": self.held_out}
        return {use: one.manifest for use, one in uses.items() if one is not None}


@eqx.filter_jit
def draw_crops(
    tiles: Float[Array, "tile side side 3"], batch: int, crop: int, key: PRNGKeyArray
) -> Crops:
    """Crops of tiles, turned and mirrored, in changed contrast, with noise of all levels.

    Grey is a random mixture of the three colours. Half of the crops are linear light, the others
    powers of it. ln σ is uniform, stratified over the batch.
    """
    keys = iter(jax.random.split(key, 12))
    count, side = tiles.shape[:2]
    chosen = jax.random.randint(next(keys), (batch,), 0, count)
    corner = jax.random.randint(next(keys), (batch, 2), 0, side - crop + 1)

    def cut(tile, place):
        return jax.lax.dynamic_slice(tiles, (tile, *place, 0), (1, crop, crop, 3))[0]

    mixture = jax.random.dirichlet(next(keys), jnp.ones(3, tiles.dtype), (batch,), tiles.dtype)
    clean = jnp.einsum("byxc,bc->byx", jax.vmap(cut)(chosen, corner), mixture, precision="highest")
    turned = jax.random.bernoulli(next(keys), shape=(3, batch, 1, 1))
    clean = jnp.where(turned[0], clean[:, ::-1], clean)
    clean = jnp.where(turned[1], clean[:, :, ::-1], clean)
    clean = jnp.where(turned[2], jnp.swapaxes(clean, 1, 2), clean)

    def uniform(low: float, high: float):
        return jax.random.uniform(next(keys), (batch, 1, 1), tiles.dtype, low, high)

    is_linear = jax.random.bernoulli(next(keys), shape=(batch, 1, 1))
    # A power below 1 has no finite slope at 0, which nothing is differentiated by here.
    power = jnp.where(is_linear, jnp.ones((), tiles.dtype), jnp.exp(uniform(*_GAMMA)))
    clean = clean**power * jnp.exp(uniform(*_GAIN))
    strata = jnp.arange(batch, dtype=tiles.dtype) + uniform(0.0, 1.0)[:, 0, 0]
    spread = math.log(MOST / LEAST) / batch
    sigma = LEAST * jnp.exp(spread * strata)
    noise = jax.random.normal(next(keys), clean.shape, tiles.dtype)
    noisy = clean + sigma[:, None, None] * noise
    offset = _OFFSET * jax.random.normal(next(keys), (batch,), tiles.dtype)
    return Crops(clean, noisy, sigma, jnp.mean(noisy, axis=(1, 2)) + offset)


def loss(network: DenoisingUNet, crops: Crops) -> tuple[Array, dict[str, Array]]:
    """Mean of RMSE/√σ: what good denoisers leave grows about as √σ, so all levels weigh the same.

    A logarithm of the error would weigh flat crops as much as those with detail.
    """
    found = denoised(network, crops.noisy, crops.sigma, crops.centre)
    error = jnp.mean((found - crops.clean) ** 2, axis=(1, 2)) / crops.sigma**2
    value = jnp.mean(jnp.sqrt((error + _LEAST_ERROR) * crops.sigma))
    return value, {"error": jnp.mean(error)}


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

    - `folder`: holds `network.thincam`, the best until now, and `training.state`; both are written
      at each check, whole or not at all. Training goes on from a state that is there, and ends
      with the same bits as without the interruption, on one machine.

    **Errors**: CheckpointError, one line, for a state that is damaged or of another training.
    """
    network = jax.tree.map(jnp.asarray, network)
    task, keep = lessons.task(options.seed), None
    state = begun = TrainingState.begin(network, task, options)
    if folder is not None:
        widths, blocks = network.shape
        record = _described(lessons, options)
        settings = {"widths": widths, "blocks": blocks, **record}
        path = Path(folder) / STATE
        before = 0.0
        if path.exists():
            state = read_state(path, begun, settings)
            before = _seconds(path.with_name(NETWORK))
        keep = functools.partial(_keep, path, settings, record, before - time.process_time())
    return train_model(task, network, options, state=state, keep=keep, callback=callback)


def _described(lessons: DenoisingLessons, options: TrainingOptions) -> dict[str, Any]:
    """The pictures with their sums and licences, the crops and the options as JSON."""
    crops = {name: getattr(lessons, name) for name in ("batch", "crop", "judged")}
    described = {"training": dataclasses.asdict(options), **crops}
    return {"images": as_json(lessons.images), **described}


def _seconds(path: Path) -> float:
    """CPU time that a network was trained for."""
    try:
        return network_card(path).cpu_seconds
    except (OSError, CheckpointError):
        return 0.0


def _keep(path: Path, settings, record, before: float, state: TrainingState) -> None:
    """Write the best network with its training record, and the state from which to resume."""
    scores = [round(float(score), 5) for score in state.scores if score == score]
    seconds = round(before + time.process_time(), 1)
    known = {**record, **state.counts, "scores": scores, "cpu_seconds": seconds}
    save_network(path.parent / NETWORK, state.best, known)
    # Last: it is what training goes on from.
    write_state(path, state, settings)
