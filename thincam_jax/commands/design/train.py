"""Designs improved by gradient through the reconstruction of training images.

What is made small is the error of the images that the cropped captures give back, so that all
counts which the frequency-wise objectives leave out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import surroundings
from thincam_jax.commands.design.config import DesignConfig, TrainingConfig
from thincam_jax.commands.design.problem import synthesis_of
from thincam_jax.design import Design, DesignSpace, Setup, Training, end_to_end_error, wiener_error
from thincam_jax.design import search as searches
from thincam_jax.imaging.targets import middle_square, resize, sample_image

# Single precision holds the error to some 1e-6 of itself.
_TOLERANCE = 1e-4
# Descents that begin nearer to each other, in the cube, most often end in one place.
_BASIN = 0.05
# Points along each side of the landscape, by the number of free numbers.
_GRID = {1: 61, 2: 15}


@dataclass(frozen=True)
class TrainingObjective:
    """The error of a reconstruction; equal objectives are compiled once."""

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


class Trained(eqx.Module):
    """Designs by their training error, best first.

    - `objective`: what was made small; `landscape`: around the best of them.
    - `found`: with the error as `objective`; `near`: of each, how the error changes around it.
    - `reference`: the error of the reference.
    - `evaluations`: of the error, with or without its gradient; `failed`: descents that met NaN.
    - `pixels`: of the sensor's side in training.
    """

    objective: TrainingObjective
    found: tuple[searches.Found, ...]
    near: tuple[surroundings.Derivatives, ...]
    reference: float
    evaluations: int
    failed: int
    pixels: int
    landscape: surroundings.Landscape | None


class TrainingDescents:
    """Descents from the best of some points of the cube, of even samples and of the reference.

    The reference counts where it keeps the limits. `setup` is that of the search.
    """

    def __init__(
        self, config: DesignConfig, wanted: TrainingConfig, setup: Setup, points: list[np.ndarray]
    ):
        self.config, self.wanted, self.space = config, wanted, config.space()
        self.objective = TrainingObjective(wanted.reconstruction)
        self.training = build_training(config, wanted, setup)
        self.starts, self.evaluations = start_points(
            self.space, self._values, points, wanted, config.seed
        )
        self.ended: list[searches.Search] = []

    def _values(self, points: Array) -> np.ndarray:
        return np.asarray(
            searches.evaluate(self.objective, self.space, self.training, points, at_a_time=1)
        )

    def descend(self, number: int) -> None:
        """From the start of that number, if there are so many."""
        start = self.starts[number : number + 1]
        if len(start):
            given = (self.objective, self.space, self.training, start)
            self.ended.append(
                searches.descend(*given, steps=self.wanted.steps, tolerance=_TOLERANCE)
            )

    def finish(self) -> Trained:
        """What the descents ended in, and what surrounds it.

        **Errors**: ConfigError where the error is NaN at every start.
        """
        found = searches.without_repeats(one for ended in self.ended for one in ended.found)
        if not found:
            raise ConfigError(
                "train: the error of the training images is NaN at any start; give "
                "reconstruction: wiener, other images, or less noise"
            )
        given = (self.objective, self.space, self.training)
        # Coarser than the search's landscape: an evaluation takes some tenths of a second.
        count = min(self.config.search.grid, _GRID[max(1, len(surroundings.shown(self.space)))])
        return Trained(
            self.objective,
            found,
            tuple(_derivatives(*given, one) for one in found),
            float(eqx.filter_jit(self.objective)(self.space.base, self.training)),
            self.evaluations + sum(ended.evaluations for ended in self.ended),
            sum(ended.failed for ended in self.ended),
            self.training.sensor.shape[0],
            surroundings.landscape_of(*given, found[0].design, count, at_a_time=1),
        )


def start_points(
    space: DesignSpace,
    values_at: Callable[[Array], np.ndarray],
    points: list[np.ndarray],
    wanted: TrainingConfig,
    seed: int,
) -> tuple[Array, int]:
    """Of points, the reference and even samples the lowest, apart from each other; and of how many.

    `values_at`: what is made small, of points (point, variable) of the cube.
    """
    own = _reference_point(space)
    dtype, key = space.lower.dtype, jax.random.key(seed)
    given = jnp.asarray(np.stack([*points, *([] if own is None else [own])]), dtype)
    every = jnp.concatenate([given, searches.even_samples(space.size, wanted.samples, key, dtype)])
    values = values_at(every)
    known = np.flatnonzero(np.isfinite(values)) if np.isfinite(values).any() else slice(None)
    best = searches.best_apart(np.asarray(every)[known], values[known], wanted.starts, least=_BASIN)
    return every[known][best], len(every)


def build_training(config: DesignConfig, wanted: TrainingConfig, setup: Setup) -> Training:
    """In the precision that JAX is set to, with noise of the configuration's seed.

    Of an oblong sensor the square of its shorter side, as everywhere in the search.
    """
    pixels = wanted.pixels or _pixels(config)
    setup = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), setup)
    # Pixels of the object about as large as those of the sensor at the longest distance.
    distances = config.reach("distance")
    across = float(setup.field) * distances[1] / float(setup.sensor_width)
    count = max(16, math.ceil(across * pixels))
    return Training(
        np.stack([_picture(name, count) for name in wanted.images]),
        setup,
        synthesis_of(config.design(config.reference), config),
        sensor_shape=(pixels, pixels),
        distances=distances,
        key=jax.random.key(config.seed),
    )


def _pixels(config: DesignConfig) -> int:
    """So that the fringes at the masks' edges, of βR/π cycles/mm, have three pixels a period.

    With fewer, their contrast is lost to the pixels' own average, and fine zones look worse than
    they are.
    """
    edge = config.reach("beta")[1] * config.reach("width")[1] / (2 * math.pi)
    needed = math.ceil(3 * edge * config.sensor.width)
    return max(32, min(needed, *config.sensor.shape))


def _picture(name: str, count: int) -> np.ndarray:
    """The grey middle square of a photograph."""
    image = np.atleast_3d(sample_image(name)).mean(axis=-1)
    return resize(middle_square(image, min(image.shape)), (count, count))


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


def _derivatives(
    objective: TrainingObjective, space: DesignSpace, training: Training, found: searches.Found
) -> surroundings.Derivatives:
    """By differences as wide as optima are apart: the error has finer ripples, of some 0.01 dB.

    At a bound, those of the nearest point that has room on either side.
    """
    size = space.size
    space, place, spans = surroundings.straight(space, found.point)
    middle = np.clip(np.asarray(place, float), searches.APART, 1 - searches.APART)
    steps = searches.APART * np.eye(size)
    points = np.concatenate([middle[None], middle + steps, middle - steps])
    points = jnp.asarray(points, space.lower.dtype)
    values = searches.evaluate(objective, space, training, points, at_a_time=1)
    level, up, down = np.split(np.asarray(values, float), [1, 1 + size])
    return surroundings.per_unit(
        (up - down) / (2 * searches.APART), (up - 2 * level + down) / searches.APART**2, spans
    )
