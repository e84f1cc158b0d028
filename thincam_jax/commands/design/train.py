"""Designs improved by gradient through the reconstruction of training images.

What is made small is the error of the images that the cropped captures give back, so that all
counts which the frequency-wise objectives leave out.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.design.config_training import TrainingConfig
from thincam_jax.commands.design.landscape import Landscape, landscape_of, shown
from thincam_jax.commands.design.problem import Problem
from thincam_jax.commands.design.sensitivity import Around, per_unit, straight
from thincam_jax.commands.study.build import synthesis_matrix
from thincam_jax.commands.study.config import ConfigError
from thincam_jax.commands.study.target import Progress
from thincam_jax.design import Design, DesignSpace, Training, end_to_end_error, wiener_error
from thincam_jax.design.search import APART, Found, best_apart, descend, evaluate, even_samples
from thincam_jax.imaging.targets import resize, sample_image

# Single precision holds the error to some 1e-6 of itself.
_TOLERANCE = 1e-4
# Descents that begin nearer to each other, in the cube, most often end in one place.
_BASIN = 0.05
# Points along each side of the landscape, by the number of free numbers.
_GRID = {1: 61, 2: 15}


@dataclass(frozen=True)
class TrainingGoal:
    """The error of a reconstruction; equal goals are compiled once."""

    reconstruction: str
    unit: str = "dB"
    label: str = "error of the training images over their variance (dB)"
    wants_more: bool = False

    def __call__(self, design: Design, training: Training) -> Float[Array, ""]:
        error = wiener_error if self.reconstruction == "wiener" else end_to_end_error
        return error(design, training)

    def told(self, value: Any) -> Any:
        """An error as it is shown, in dB."""
        return 10 * np.log10(np.asarray(value, dtype=float))


class Trained(NamedTuple):
    """Designs by their training error, best first.

    - `goal`: what was made small; `landscape`: around the best of them.
    - `found`: with the error as `objective`; `around`: of each.
    - `reference`: the error of the reference.
    - `evaluations`: of the error, with or without its gradient; `failed`: descents that met no
      number.
    - `pixels`: of the sensor's side in training.
    """

    goal: TrainingGoal
    found: tuple[Found, ...]
    around: tuple[Around, ...]
    reference: float
    evaluations: int
    failed: int
    pixels: int
    landscape: Landscape | None


def train_steps(wanted: TrainingConfig | None) -> int:
    """How many times `train` reports progress: samples, descents, and what surrounds the best."""
    return 0 if wanted is None else wanted.starts + 2


def train(
    config: DesignConfig,
    wanted: TrainingConfig,
    problem: Problem,
    points: list[np.ndarray],
    progress: Progress,
) -> Trained:
    """Descents from the best of some points of the cube, of even samples and of the reference.

    The reference counts where it keeps the limits.

    **Errors**: ConfigError where the error is no number at any start.
    """
    goal, space = TrainingGoal(wanted.reconstruction), config.space()
    training = build_training(config, wanted, problem)
    progress("training, samples")
    starts, sampled = _starts(config, wanted, goal, space, training, points)
    # Steps were counted before it was known whether there are as many.
    for _ in range(wanted.starts - len(starts)):
        progress("training")
    ended = descend(
        goal,
        space,
        training,
        starts,
        steps=wanted.steps,
        tolerance=_TOLERANCE,
        told=lambda place: progress(f"training {place + 1} of {len(starts)}"),
    )
    if not ended.found:
        raise ConfigError(
            "train: the error of the training images is no number at any start; give "
            "reconstruction: wiener, other images, or less noise"
        )
    progress("around the trained designs")
    around = tuple(_around(goal, space, training, found) for found in ended.found)
    reference = eqx.filter_jit(goal)(space.base, training)
    return Trained(
        goal,
        ended.found,
        around,
        float(reference),
        ended.evaluations + sampled,
        ended.failed,
        training.sensor.shape[0],
        _surroundings(config, goal, space, training, ended.found),
    )


def _starts(config: DesignConfig, wanted: TrainingConfig, goal, space, training, points):
    """The lowest in training error, apart from each other; and of how many."""
    own = _reference_point(space)
    dtype, key = space.lower.dtype, jax.random.key(config.seed)
    given = jnp.asarray(np.stack([*points, *([] if own is None else [own])]), dtype)
    every = jnp.concatenate([given, even_samples(space.size, wanted.samples, key, dtype)])
    values = np.asarray(evaluate(goal, space, training, every, at_a_time=1))
    known = np.flatnonzero(np.isfinite(values)) if np.isfinite(values).any() else slice(None)
    best = best_apart(np.asarray(every)[known], values[known], wanted.starts, least=_BASIN)
    return every[known][best], len(every)


def _surroundings(config: DesignConfig, goal, space: DesignSpace, training, found):
    """Coarser than the search's landscape: an evaluation takes some tenths of a second."""
    count = min(config.search.grid, _GRID[max(1, len(shown(space)))])
    phases = len(config.reference.method().shot_phases())
    return landscape_of(goal, space, training, found[0].design, count, phases, at_a_time=1)


def build_training(config: DesignConfig, wanted: TrainingConfig, problem: Problem) -> Training:
    """In the precision that JAX is set to, with noise of the configuration's seed.

    Of an oblong sensor the square of its shorter side, as everywhere in the search.
    """
    pixels = wanted.pixels or _pixels(config)
    setup = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), problem.data.setup)
    # Pixels of the object about as large as those of the sensor at the longest distance.
    across = float(setup.field) * config.farthest() / float(setup.sensor_width)
    count = max(16, math.ceil(across * pixels))
    return Training(
        np.stack([_picture(name, count) for name in wanted.images]),
        setup,
        synthesis_matrix(config.reference.method()),
        sensor_shape=(pixels, pixels),
        distances=(config.nearest(), config.farthest()),
        key=jax.random.key(config.seed),
    )


def _pixels(config: DesignConfig) -> int:
    """So that the fringes at the masks' edges, of βR/π cycles/mm, have three pixels a period.

    With fewer, their contrast is lost to the pixels' own average, and fine zones look worse than
    they are.
    """
    finest = [s.beta for s in config.reference.shots]
    finest += [f.bounds[1] for f in config.search.free if f.variable == "beta"]
    edge = max(finest) * config.widest() / (2 * math.pi)
    needed = math.ceil(3 * edge * config.sensor.width)
    return max(32, min(needed, *config.sensor.shape))


def _picture(name: str, count: int) -> np.ndarray:
    """The grey middle square of a photograph."""
    image = np.atleast_3d(sample_image(name)).mean(axis=-1)
    side = min(image.shape)
    top, left = ((n - side) // 2 for n in image.shape)
    return resize(image[top : top + side, left : left + side], (count, count))


def _reference_point(space: DesignSpace) -> np.ndarray | None:
    """Where the reference lies in the cube; None where it is not in it."""
    shared = (
        getattr(space.base, v.name)[jnp.asarray(v.captures)] for v in space.variables if v.captures
    )
    room = bool(jnp.all(space.highest(space.base.width) > space.lower))
    if not room or any(np.ptp(np.asarray(own)) > 0 for own in shared):
        return None
    point = np.asarray(space.point(space.base), dtype=float)
    # On a bound, rounding may put it outside.
    inside = np.all((point >= -1e-5) & (point <= 1 + 1e-5))
    return np.clip(point, 0.0, 1.0) if inside else None


def _around(goal: TrainingGoal, space: DesignSpace, training: Training, found: Found) -> Around:
    """By differences as wide as optima are apart: the error has finer ripples, of some 0.01 dB.

    At a bound, those of the nearest point that has room on either side.
    """
    size = space.size
    space, place, spans = straight(space, found.point)
    middle = np.clip(np.asarray(place, float), APART, 1 - APART)
    steps = APART * np.eye(size)
    points = np.concatenate([middle[None], middle + steps, middle - steps])
    values = evaluate(goal, space, training, jnp.asarray(points, space.lower.dtype), at_a_time=1)
    level, up, down = np.split(np.asarray(values, float), [1, 1 + size])
    return per_unit((up - down) / (2 * APART), (up - 2 * level + down) / APART**2, spans)
