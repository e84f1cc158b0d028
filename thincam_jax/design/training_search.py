"""Search by gradient through the reconstruction of training images.

What is minimised is the error of the images that the cropped captures give back, so that all
counts which the frequency-wise objectives leave out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import whole
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.design import Design
from thincam_jax.design.end_to_end import end_to_end_error
from thincam_jax.design.landscape import Landscape, drawn_variables, landscape_if_any
from thincam_jax.design.objectives import AbstractObjective
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import (
    Found,
    NonFiniteObjectiveError,
    Search,
    best_apart,
    descend,
    evaluate,
    even_samples,
    without_repeats,
)
from thincam_jax.design.sensitivity import Derivatives, derivatives
from thincam_jax.design.setup import Setup
from thincam_jax.design.space import DesignSpace
from thincam_jax.design.training import TrainedSensor, Training
from thincam_jax.design.wiener import wiener_error
from thincam_jax.imaging.targets import middle_square, resize

# Single precision holds the error to some 1e-6 of itself.
_TOLERANCE = 1e-4
# Descents that begin nearer to each other, in the cube, most often end in one place.
_BASIN = 0.05
# Points along each side of the landscape, by the number of free numbers.
_GRID = {1: 61, 2: 15}


@dataclass(frozen=True)
class TrainingError(AbstractObjective):
    """Error of training images; its data are `Training`.

    - `reconstruction`: "wiener", the Wiener synthesis; "linear", the best linear estimate, which
      knows of the crop, by conjugate gradients; "pnp", plug and play with the training's denoiser.
    """

    name: ClassVar[str] = "training_error"
    quantity: ClassVar[str] = "error of the training images over their variance"
    reconstruction: Literal["wiener", "linear", "pnp"] = "wiener"

    def value(self, design: Design, data: Training) -> Float[Array, ""]:
        if self.reconstruction == "pnp" and data.denoiser is None:
            raise ValueError("reconstruction 'pnp' needs a denoiser; see Training.with_denoiser")
        error = wiener_error if self.reconstruction == "wiener" else end_to_end_error
        return error(design, data)

    def reported(self, cost: Any) -> Any:
        return 10 * np.log10(np.asarray(cost, dtype=float))


@dataclass(frozen=True)
class TrainingSettings:
    """Length of a training: descents of `steps` from the best `starts` of even `samples`.

    - `grid`: points along each side of the landscape, at most.
    """

    samples: Annotated[int, whole(1, 10_000)] = 64
    starts: Annotated[int, whole(1, 10)] = 4
    steps: Annotated[int, whole(1, 1000)] = 30
    grid: int = 61


class TrainedDesigns(eqx.Module):
    """Designs by their training error, best first.

    - `objective`: objective that was minimised; `landscape`: its values around the best design.
    - `found`: designs with the error as `objective`; `near`: derivatives of the error around each.
    - `reference`: the error of the space's base.
    - `evaluations`: number of evaluations of the error, with or without its gradient; `failed`:
      descents that met NaN.
    - `pixels`: number of pixels of the sensor's side in training.
    """

    objective: Objective
    found: tuple[Found, ...]
    near: tuple[Derivatives, ...]
    reference: float
    evaluations: int
    failed: int
    pixels: int
    landscape: Landscape | None


@watched("training designs")
def train_designs(
    problem: DesignProblem,
    points: Sequence[np.ndarray],
    settings: TrainingSettings | None = None,
    *,
    key: Key,
) -> TrainedDesigns:
    """Designs of least training error, by descents from the best of points and even samples.

    - `problem`: problem of a `TrainingError`, its space and a `Training`.
    - `points`: starts in the unit cube, such as those that a search found. The base counts as one
      more where it keeps the limits.

    **Errors**: NonFiniteObjectiveError where the error is NaN at every start.
    """
    key = random_key(key)
    descents = TrainingDescents(problem, points, settings or TrainingSettings(), key)
    for number in range(descents.settings.starts):
        descents.descend(number)
    return descents.finish()


class TrainingDescents:
    """`train_designs` in steps: `descend` from each start, then `finish`."""

    def __init__(
        self,
        problem: DesignProblem,
        points: Sequence[np.ndarray],
        settings: TrainingSettings,
        key: PRNGKeyArray,
    ):
        self.problem, self.settings = problem, settings

        def values(at: Array) -> np.ndarray:
            given = problem.objective, problem.space, problem.data, at
            return np.asarray(evaluate(*given, at_a_time=1))

        self.starts, self.evaluations = start_points(problem.space, values, points, settings, key)
        self.ended: list[Search] = []

    def descend(self, number: int) -> None:
        """Run the descent from the start of that number, if there are so many."""
        start = self.starts[number : number + 1]
        if len(start):
            steps = self.settings.steps
            self.ended.append(descend(self.problem, start, steps=steps, tolerance=_TOLERANCE))

    def finish(self) -> TrainedDesigns:
        """The designs where the descents ended, and the error around them.

        **Errors**: NonFiniteObjectiveError where the error is NaN at every start.
        """
        found = without_repeats(one for ended in self.ended for one in ended.found)
        if not found:
            raise NonFiniteObjectiveError(
                "the error of the training images is NaN at any start; give "
                "reconstruction: wiener, other images, or less noise"
            )
        problem = self.problem
        objective, space, training = problem.objective, problem.space, problem.data
        # Coarser than the search's landscape: an evaluation takes some tenths of a second.
        count = min(self.settings.grid, _GRID[max(1, len(drawn_variables(space)))])
        return TrainedDesigns(
            objective,
            found,
            tuple(
                derivatives(problem.objective, problem.space, problem.data, one.point)
                for one in found
            ),
            float(eqx.filter_jit(objective)(space.base, training)),
            self.evaluations + sum(ended.evaluations for ended in self.ended),
            sum(ended.failed for ended in self.ended),
            training.sensor.shape[0],
            landscape_if_any(problem, found[0].design, count, at_a_time=1),
        )


def start_points(
    space: DesignSpace,
    values_at: Callable[[Array], np.ndarray],
    points: Sequence[np.ndarray],
    settings: TrainingSettings,
    key: PRNGKeyArray,
) -> tuple[Array, int]:
    """Lowest of points, the base and even samples, apart from each other; and of how many.

    `values_at`: costs of points (point, variable) of the cube.
    """
    own = base_point(space)
    dtype = space.lower.dtype
    given = jnp.asarray(np.stack([*points, *([] if own is None else [own])]), dtype)
    every = jnp.concatenate([given, even_samples(space.size, settings.samples, key, dtype)])
    values = values_at(every)
    known = np.flatnonzero(np.isfinite(values)) if np.isfinite(values).any() else slice(None)
    best = best_apart(np.asarray(every)[known], values[known], settings.starts, least=_BASIN)
    return every[known][best], len(every)


def base_point(space: DesignSpace) -> np.ndarray | None:
    """Point of the base in the unit cube; None where it lies outside."""
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


def build_training(
    photographs: Sequence[np.ndarray],
    space: DesignSpace,
    setup: Setup,
    synthesis: Float[np.ndarray, "channel capture"],
    *,
    pixels: int,
    key: Key,
) -> Training:
    """Training on the grey middle squares of photographs, for all distances of a space.

    In the precision that JAX is set to. Of an oblong sensor the square of its shorter side, as
    everywhere in the search.

    - `photographs`: (y, x) or (y, x, channel). `pixels`: along the sensor's side.
    """
    key = random_key(key)
    setup = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), setup)
    # Pixels of the object about as large as those of the sensor at the longest distance.
    distances = space.reach("distance")
    across = float(setup.field) * distances[1] / float(setup.sensor_width)
    count = max(16, math.ceil(across * pixels))
    grey = [np.atleast_3d(image).mean(axis=-1) for image in photographs]
    squares = [resize(middle_square(image, min(image.shape)), (count, count)) for image in grey]
    return Training(
        np.stack(squares), setup, synthesis, TrainedSensor((pixels, pixels), distances), key=key
    )


def training_pixels(space: DesignSpace, setup: Setup, sensor_shape: tuple[int, int]) -> int:
    """Pixels along the side of a sensor in training, at most as many as it has.

    The fringes at the masks' edges, of βR/π cycles/mm, have three pixels a period. With fewer,
    their contrast is lost to the pixels' own average, and fine zones look worse than they are.
    """
    edge = space.reach("beta")[1] * space.reach("width")[1] / (2 * math.pi)
    needed = math.ceil(3 * edge * float(setup.sensor_width))
    return max(32, min(needed, *sensor_shape))
