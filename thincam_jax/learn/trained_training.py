"""Training of a reconstruction for one camera, in a folder that it goes on from.

First the few numbers of the physics step are fitted, then the network learns on crops of images
that the fitted step has made once, so that a step of the training costs no optics.
"""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.quantity import FieldError, check_fields, whole
from thincam_jax.imaging.operators.crop_convolution import centred_crop
from thincam_jax.learn.sources import Entry, as_json
from thincam_jax.learn.trained import PhysicsStep, TrainedReconstruction, cleaned, refined
from thincam_jax.learn.trained_lessons import CameraLessons, PairLessons, PreparedExamples
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
from thincam_jax.learn.unet import UNet
from thincam_jax.reconstruction.problem import InverseProblem, or_one
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.studies.agreement import agreement

STATE = "training.state"
# Of the seeds: captures that fit the physics step, that train, and that judge.
_FITTING, _TRAINING, _JUDGING = 0, 1, 2
_LEAST = 1e-5  # of the squared error: 50 dB
_SCORED = 8  # captures whose whole images are scored at the end
_PARTS = 0.0, 0.25, 0.5, 0.75, 1.0  # of what the network adds, from which judges choose
_NOISES = np.log(10.0) * np.arange(-3.0, 3.1, 0.5)  # ln λ that are tried


ExampleSource = CameraLessons | PairLessons


@dataclass(frozen=True, eq=False)
class ReconstructionLessons:
    """Training set of a trained reconstruction.

    - `camera`: captures that fit the physics step. `train`, `judge`: captures that train the
      network, and those that judge it, which no step sees; by default those of the camera.
    - `fitted`: captures that fit the physics step.
    - `pool`, `judged`: number of captures, drawn once. `batch`, `crop`: crops of a step, and their
      sides in pixels.
    - `images`: entries of all pictures by their use.
    """

    camera: CameraLessons
    train: ExampleSource | None = None
    judge: ExampleSource | None = None
    fitted: Annotated[int, whole(1, 1000)] = 6
    pool: Annotated[int, whole(1, 1_000_000)] = 400
    judged: Annotated[int, whole(1, 10_000)] = 16
    batch: Annotated[int, whole(1, 1024)] = 8
    crop: Annotated[int, whole(8, 4096)] = 96
    images: dict[str, tuple[Entry, ...]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        check_fields(self)
        if self.crop > min(self.camera.sensor):
            most = min(self.camera.sensor)
            raise FieldError(f"crop = {self.crop}: give at most {most}, the sensor's side", "crop")

    def task(self, physics: PhysicsStep, seed: int) -> Task:
        """Crops to be drawn, and those that judge."""
        train, judge = (self.train or self.camera), (self.judge or self.camera)
        pool = train.examples(physics, _seed(seed, _TRAINING), self.pool)
        judges = judge.examples(physics, _seed(seed, _JUDGING), self.judged)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 2**31), self.judged)
        crop = min(self.crop, *pool.truth.shape[-2:])  # truths of pairs may be smaller
        judged = [_crops(judges, self.batch, crop, key) for key in keys]
        return Task(functools.partial(_drawn, pool, self.batch, crop), loss, judged)

    def fit(self, physics: PhysicsStep, seed: int) -> PhysicsStep:
        """The physics step with the λ that suits drawn captures of the camera best."""
        drawn = [self.camera.drawn(_seed(seed, _FITTING), n) for n in range(self.fitted)]
        errors = np.zeros((len(_NOISES), len(self.camera.psf)))
        for recording, scene in drawn:
            problem, images = physics(recording)
            truth = jnp.asarray(scene)
            errors += [np.asarray(_error(problem, images[-1], one, truth)) for one in _NOISES]
        noise = jnp.asarray(_NOISES[errors.argmin(axis=0)], jnp.float32)
        return dataclasses.replace(physics, noise=noise)


def _seed(seed: int, use: int) -> int:
    return 3 * seed + use


@eqx.filter_jit
def _error(problem: InverseProblem, image: Image, level, truth) -> Float[Array, " colour"]:
    """Part of the error of the image that its filtered residual leaves, at the best gain.

    At a gain of 1 a PSF that is wrong makes the residual useless, and λ infinite.
    """
    found = refined(problem, image, jnp.full(len(truth), level))
    sensor, image = problem.captures[0].shape[-2:], image[..., 0, :, :]
    change, error = (centred_crop(one - image, sensor) for one in (found, truth))
    size, power = (jnp.sum(one**2, axis=(1, 2)) for one in (change, error))
    return 1 - jnp.sum(change * error, axis=(1, 2)) ** 2 / (or_one(size) * or_one(power))


def loss(network: UNet, given: PreparedExamples) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean over crops of ½ ln of the squared error: 0.115 less is 1 dB; and the last input's.

    Crops count alike, however wrong the physics step is there. By the mean absolute error a few
    captures that it cannot explain at all outweigh the others, and good images become worse.
    """
    images, truth = (leaf.astype(jnp.float32) for leaf in (given.images, given.truth))
    inputs = jnp.moveaxis(images, 1, 0)
    found = cleaned(network, network.leave.weight.shape[0] // 4, inputs)
    errors = (jnp.mean((one - truth) ** 2, axis=(1, 2, 3)) for one in (inputs[-1], found))
    before, after = (jnp.mean(jnp.log(one + _LEAST)) / 2 for one in errors)
    return after, {"before": before}


def _drawn(pool: PreparedExamples, batch: int, crop: int, key: PRNGKeyArray) -> PreparedExamples:
    """Crops of the pool; where several devices are there, each holds its part of them."""
    crops = _crops(pool, batch, crop, key)
    devices = jax.devices()
    if len(devices) > 1 and batch % len(devices) == 0:
        mesh = jax.sharding.Mesh(np.asarray(devices), ("batch",))
        parts = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
        crops = jax.device_put(crops, parts)
    return crops


@eqx.filter_jit
def _crops(pool: PreparedExamples, batch: int, crop: int, key: PRNGKeyArray) -> PreparedExamples:
    """Crops at random places, turned and mirrored."""
    chosen, places, turns = jax.random.split(key, 3)
    count, *_, rows, columns = pool.truth.shape
    numbers = jax.random.randint(chosen, (batch,), 0, count)
    most = jnp.asarray((rows - crop + 1, columns - crop + 1))
    corners = jax.random.randint(places, (batch, 2), 0, most)

    def cut(leaf, number, corner):
        start = (number, *(0,) * (leaf.ndim - 3), *corner)
        return jax.lax.dynamic_slice(leaf, start, (1, *leaf.shape[1:-2], crop, crop))[0]

    cutting = jax.vmap(cut, in_axes=(None, 0, 0))
    crops = jax.tree.map(lambda leaf: cutting(leaf, numbers, corners), pool)
    turned = jax.random.bernoulli(turns, shape=(3, batch))

    def turn(leaf):
        down, across, over = (t.reshape(batch, *(1,) * (leaf.ndim - 1)) for t in turned)
        leaf = jnp.where(down, leaf[..., ::-1, :], leaf)
        leaf = jnp.where(across, leaf[..., ::-1], leaf)
        return jnp.where(over, jnp.swapaxes(leaf, -2, -1), leaf)

    return jax.tree.map(turn, crops)


def train_reconstruction(
    untrained: TrainedReconstruction,
    lessons: ReconstructionLessons,
    options: TrainingOptions,
    *,
    folder: str | os.PathLike[str] | None = None,
    callback: Callable[[TrainingProgress], object] | None = None,
) -> Trained:
    """Fit the physics step, then train the network; the result's `model` is the whole.

    A network that learned its captures by heart adds too much: the part of it that is kept is the
    best of five for the captures that judge, see `tempered`.

    **Arguments**

    - `untrained`: new, or trained before, for other captures of the camera.
    - `folder`: holds `network.thincam` and `training.state`; see `TrainingFiles`.

    **Errors**: CheckpointError, one line, for a state that is damaged or of another training.
    """
    path = None if folder is None else Path(folder) / STATE
    if path is not None and path.exists():
        physics = TrainedReconstruction.load(path.with_name(NETWORK)).physics
    else:
        physics = lessons.fit(untrained.physics, options.seed)
    made, train = dataclasses.replace(untrained, physics=physics), train_model
    record = described(lessons, options)
    if path is not None:
        camera = "" if made.camera is None else made.camera.digest
        settings = {"sizes": dataclasses.asdict(made.options), "camera": camera, **record}
        save = functools.partial(_save, path.with_name(NETWORK), made, record)
        train = TrainingFiles(path, settings, save).train
    task = lessons.task(physics, options.seed)
    trained = train(task, made.network, options, callback=callback)
    # The arrays of a state that was read are NumPy's.
    network, part = tempered(jax.tree.map(jnp.asarray, trained.model), task.validation)
    whole_model = dataclasses.replace(made, network=network)
    if path is not None:
        whole_model.save(path.with_name(NETWORK), {**record, **trained.state.record, "part": part})
    return Trained(whole_model, trained.state, trained.status)


def tempered(network: UNet, judged: Sequence[PreparedExamples]) -> tuple[UNet, float]:
    """The network that adds the part of its output that suits examples best, and that part."""

    def adding(part: float) -> UNet:
        leave = jax.tree.map(lambda leaf: jnp.asarray(part, leaf.dtype) * leaf, network.leave)
        return eqx.tree_at(lambda one: one.leave, network, leave)

    score = eqx.filter_jit(lambda one, given: loss(one, given)[0])
    scores = {p: np.mean([float(score(adding(p), one)) for one in judged]) for p in _PARTS}
    best = min(scores, key=lambda part: scores[part])
    return adding(best), best


def gains(
    model: TrainedReconstruction, lessons: ReconstructionLessons, seed: int
) -> list[tuple[float, float]]:
    """PSNR, dB, of the physics step's images of captures held out, and of the trained ones.

    Levels are fitted, see `studies.agreement`.
    """
    judge = lessons.judge or lessons.camera
    count = min(_SCORED, lessons.judged)
    drawn = judge.examples(model.physics, _seed(seed, _JUDGING), count)
    rows = []
    for images, truth in zip(drawn.images, drawn.truth, strict=True):
        images, known = images.astype(jnp.float32), np.asarray(truth, np.float32)
        found = jnp.maximum(cleaned(model.network, model.options.colours, images), 0)
        pair = (agreement(np.asarray(one), known).psnr_db for one in (images[-1], found))
        before, after = (math.inf if value is None else value for value in pair)
        rows.append((before, after))
    return rows


def described(lessons: ReconstructionLessons, options: TrainingOptions) -> dict[str, Any]:
    """Pictures with their sums and licences, faults, sizes and options as JSON."""
    sizes = ("fitted", "pool", "judged", "batch", "crop")
    return {
        "images": as_json(lessons.images),
        "faults": dataclasses.asdict(lessons.camera.faults),
        "sensor": lessons.camera.sensor,
        "training": dataclasses.asdict(options),
        **{name: getattr(lessons, name) for name in sizes},
    }


def _save(path: Path, made: TrainedReconstruction, record, state: TrainingState) -> None:
    """Write the best network with its training record."""
    best = dataclasses.replace(made, network=state.best)
    best.save(path, {**record, **state.record})
