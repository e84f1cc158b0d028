"""Training of a refocusing network on drawn scenes, in a folder that it goes on from."""

import dataclasses
import functools
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.quantity import check_fields, whole
from thincam_jax._core.table import Table
from thincam_jax.learn.refocusing.cameras import Stand
from thincam_jax.learn.refocusing.network import RefocusNetwork, normalised, prepared, read_images
from thincam_jax.learn.refocusing.scenes import Batch, SceneOptions, draw_batch
from thincam_jax.learn.refocusing.sources import Entry, Source, as_json
from thincam_jax.learn.refocusing.store import described
from thincam_jax.learn.refocusing.unet import UNet
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

Parts = dict[str, Float[Array, ""]]

# Of the parts in the loss.
_SHARES = {"focus": 1.0, "all_in_focus": 0.3, "planes": 0.1, "distance": 0.1}
_LEAST = 1e-5  # of an image's mean square: an error below it counts for nothing


class Examples(eqx.Module):
    """Input and target of a U-Net for one scene or, (element, …), for many.

    - `images`: images by `prepared`, for planes at `stand`.
    - `stack`: light of the planes; what stands between two is shared out between them.
    - `image`, `all_in_focus`: in units of the scene's mean; `inverse`: 1/t, 1/mm.
    """

    images: Float[Array, "*element image y x"]
    stand: Stand
    stack: Float[Array, "*element plane y x"]
    image: Float[Array, "*element y x"]
    all_in_focus: Float[Array, "*element y x"]
    inverse: Float[Array, "*element y x"]

    def mirrored(self, rows: Array, columns: Array) -> "Examples":
        """Upside down where `rows` is true, left to right where `columns` is.

        Masks and sensors are the same in a mirror, so that these are captures, too.
        """

        def turned(leaf):
            leaf = jnp.where(rows, leaf[..., ::-1, :], leaf)
            return jnp.where(columns, leaf[..., ::-1], leaf)

        names = ("images", "stack", "image", "all_in_focus", "inverse")
        return replace(self, **{name: turned(getattr(self, name)) for name in names})


@eqx.filter_jit
def examples(network: RefocusNetwork, batch: Batch) -> Examples:
    """Input and target of a network's last U-Net for a batch."""
    return jax.vmap(lambda one: _example(network, one))(batch)


def _example(network: RefocusNetwork, one: Batch) -> Examples:
    planes, stack = network.planes, None
    mean, capture, sigma = normalised(planes, one.capture, one.deviation)
    stand = network.camera.stand(one.commanded)
    given = (capture, sigma, stand, planes.spectra_at(1 / stand.inverse))
    last = len(network.weights.prior) - 1
    for number in range(last):
        images = prepared(network, number, stack, given)
        stack = read_images(network.weights.prior[number], images, stand).stack
    unit = jnp.where(mean > 0, mean, 1)
    shares = stand.splat(one.scene.inverse)  # (plane, layer, part)
    return Examples(
        prepared(network, last, stack, given),
        stand,
        jnp.einsum("klp,lpyx->kyx", shares, one.emission, precision="highest") / unit,
        one.image / unit,
        one.all_in_focus / unit,
        one.inverse,
    )


def loss(prior: UNet, given: Examples) -> tuple[Float[Array, ""], Parts]:
    r"""The loss of a U-Net, differentiable in it, and its parts, each a mean over the examples.

    - `focus`, `all_in_focus`: ½ ln of the mean squared error over the image's mean square; a
      decrease by 0.115 is 1 dB, however bright or hard the scene is.
    - `planes`: that of the stack.
    - `distance`: −ln of the Laplace density of 1/t at each pixel, in steps of the planes, with the
      error that the network expects.
    """
    parts = jax.vmap(lambda one: _parts(prior, one))(given)
    parts = {name: jnp.mean(part) for name, part in parts.items()}
    total = sum((_SHARES[name] * part for name, part in parts.items()), jnp.zeros(()))
    return total.astype(given.images.dtype), parts


def _parts(prior: UNet, one: Examples) -> Parts:
    """Parts of the loss of one element."""
    stand = one.stand
    cleaned = read_images(prior, one.images, stand)
    step = (stand.inverse[0] - stand.inverse[-1]) / (stand.inverse.size - 1)
    error = jnp.abs(cleaned.inverse_distance(stand) - one.inverse) / step
    spread = cleaned.spread
    return {
        "focus": relative_error(cleaned.image, one.image),
        "all_in_focus": relative_error(cleaned.all_in_focus, one.all_in_focus),
        "planes": relative_error(cleaned.stack, one.stack),
        "distance": jnp.mean(error / spread + jnp.log(spread)),
    }


def relative_error(image: Array, target: Array) -> Float[Array, ""]:
    """½ ln of the mean squared error over the target's mean square."""
    size = jnp.mean(target**2)
    ratio = jnp.mean((image - target) ** 2) / jnp.where(size > 0, size, 1)
    return jnp.log(ratio + _LEAST) / 2


STATE = "training-{}.state"
# Of the seed's key: scenes of the pools have the numbers of their batches.
_JUDGED = 2**31


@dataclasses.dataclass(frozen=True, eq=False)
class Lessons:
    """Training set of a network.

    - `source`: the images; `scenes`: options of the scenes drawn from them.
    - `batch`: scenes of a step, taken out of a pool of so many batches, which is drawn once.
    - `judged`: batches that judge the network at each check, drawn of `held_out` images, which no
      step sees; by default of the same.
    """

    source: Source
    scenes: SceneOptions = SceneOptions()
    batch: Annotated[int, whole(1, 1024)] = 2
    pool: Annotated[int, whole(1, 1_000_000)] = 256
    judged: Annotated[int, whole(1, 1000)] = 4
    held_out: Source | None = None

    def __post_init__(self):
        check_fields(self)

    def drawn(self, network: RefocusNetwork, seed: int, count: int, first: int = 0):
        """Batches of the camera of a network, one after another."""
        source = self.source
        if first >= _JUDGED and self.held_out is not None:
            source = self.held_out
        images, key = jnp.asarray(source.images), jax.random.key(seed)
        for number in range(first, first + count):
            one = jax.random.fold_in(key, number)
            yield draw_batch(one, images, network.camera, self.scenes, self.batch)

    def validation(self, network: RefocusNetwork, seed: int) -> list[Batch]:
        """Validation set of a network."""
        return list(self.drawn(network, seed, self.judged, _JUDGED))

    def task(self, network: RefocusNetwork, seed: int) -> Task:
        """Task of training the last U-Net of a network; those before it stay as they are."""
        pool = [examples(network, one) for one in self.drawn(network, seed, self.pool)]
        pool = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pool)
        judged = [examples(network, one) for one in self.validation(network, seed)]
        return Task(functools.partial(_taken, pool, self.batch), loss, judged)

    @property
    def images(self) -> dict[str, tuple[Entry, ...]]:
        """Entries of all images by their use."""
        sources = {"trained on": self.source, "judged on": self.held_out}
        return {use: one.manifest for use, one in sources.items() if one is not None}

    def images_table(self) -> Table:
        """Every image with its use, licence and the beginning of its sum."""
        rows = [
            (entry.name, use, entry.licence, f"{entry.sha256[:16]}…")
            for use, entries in self.images.items()
            for entry in entries
        ]
        return Table(("image", "use", "licence", "SHA-256"), rows)


@eqx.filter_jit
def _taken(pool: Examples, size: int, key) -> Examples:
    chosen, mirrors = jax.random.split(key)
    numbers = jax.random.randint(chosen, (size,), 0, len(pool.image))
    rows, columns = jax.random.bernoulli(mirrors, shape=(2,))
    return jax.tree.map(lambda leaf: leaf[numbers], pool).mirrored(rows, columns)


def train(
    network: RefocusNetwork,
    lessons: Lessons,
    options: TrainingOptions,
    *,
    folder: str | os.PathLike[str] | None = None,
    callback: Callable[[TrainingProgress], object] | None = None,
) -> Trained:
    """Train the U-Nets of a network one after another, each for its share of the steps.

    What a U-Net sees of a scene depends on those before it alone, so that the optics are computed
    once for each scene of the pool and not at every step. See `train_model` for one U-Net.

    **Arguments**

    - `folder`: holds `network.thincam` and a state for each U-Net; see `TrainingFiles`.

    **Errors**: CheckpointError, one line, for a state that is damaged or of another training.
    """
    count = network.options.steps
    each = dataclasses.replace(options, steps=-(-options.steps // count))
    record = _described(lessons, options)
    settings = {
        "camera": described(network.camera),
        "options": dataclasses.asdict(network.options),
        **record,
    }
    losses, scores, trained = [], [], None
    for number in range(count):
        part, go, tell = network.first(number + 1), train_model, None
        if folder is not None:
            save = functools.partial(_save, Path(folder) / NETWORK, part, record)
            own, state = {**settings, "step": number}, Path(folder) / STATE.format(number + 1)
            go = TrainingFiles(state, own, save).train
        if callback is not None:
            tell = functools.partial(_tell, callback, number, count, time.perf_counter())
        task, prior = lessons.task(part, options.seed), part.weights.prior[number]
        trained = go(task, prior, each, callback=tell)
        network = network.with_prior(number, trained.model)
        losses.append(trained.state.losses[: trained.state.step])
        scores.append(trained.state.scores)
        if trained.status != "finished":
            break
    assert trained is not None  # there is at least one step
    known = {"losses": np.concatenate(losses), "scores": np.concatenate(scores)}
    state = dataclasses.replace(trained.state, step=len(known["losses"]), **known)
    return Trained(network.first(len(losses)), state, trained.status)


def _described(lessons: Lessons, options: TrainingOptions) -> dict[str, Any]:
    """The images with their sums and licences, how scenes are drawn and the options as JSON."""
    drawn = {name: getattr(lessons, name) for name in ("batch", "pool", "judged")}
    described = {"scenes": lessons.scenes, "training": options}
    described = {name: dataclasses.asdict(one) for name, one in described.items()}
    return {"images": as_json(lessons.images), **drawn, **described}


def _save(path: Path, network: RefocusNetwork, record, state: TrainingState) -> None:
    """Write the network with its best last U-Net, and its training record."""
    number = network.options.steps - 1
    best = network.with_prior(number, eqx.combine(state.best, network.weights.prior[number]))
    best.save(path, {**record, **state.record})


def _tell(callback, number: int, parts: int, began: float, progress: TrainingProgress) -> object:
    """Tells of the whole training in place of that of U-Net `number` of its `parts`."""
    steps, later = progress.steps, parts - 1 - number
    each = (time.perf_counter() - began) / progress.step
    whole = dataclasses.replace(
        progress,
        step=number * steps + progress.step,
        steps=parts * steps,
        seconds_left=progress.seconds_left + later * steps * each,
    )
    return callback(whole)
