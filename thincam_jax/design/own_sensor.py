"""Design for an own sensor: two pitches and a distance, in seconds for any number of pixels."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.precision import allow, cast, decimal_value
from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import quantity
from thincam_jax._core.table import Table
from thincam_jax.design.design import Design, shots
from thincam_jax.design.objectives import BayesError
from thincam_jax.design.problem import DesignProblem, FrequencyCounts, design_problem
from thincam_jax.design.search import Found, best_apart, best_random, evaluate, improved, sampled
from thincam_jax.design.setup import PhotonNoise, PowerLaw, Setup, SignalNoise
from thincam_jax.design.space import DesignSpace, Variable
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.reconstruction.synthesis import phase_pairs

# Pitches, rad/mm², distance and light, mm, and phases of the thesis' section 3.5.1.
_BETAS, _DISTANCE, _LIGHT, _PHASES = (25.0, 21.0), 6.5, 500e-6, (0.0, 1.5 * math.pi)
# Frequencies along an axis to sample and to improve; samples of either round, and the best of the
# first, which bound the second; starts; step along a plateau, as a part of the bounds.
_COARSE, _FINE, _SAMPLES, _BEST, _STARTS, _STEP = 128, 256, 256, 32, 4, 1 / 512
PLATEAU_DB = 0.1


@dataclass(frozen=True, eq=False)
class SensorDesign:
    """Design found for a sensor, beside the thesis' pair and a random search of equal cost.

    - `problem`: its problem, for `sensitivity_around` and the other functions of problems.
    - `best`: the design found, with its numbers in `values`; `random`: the best of `evaluations`
      random ones.
    - `errors_db`: expected errors of `best`, the thesis' pair and `random`, see `BayesError`.
    - `plateaus`: ends of each free number up to which the error is within 0.1 dB, the others held.
    """

    problem: DesignProblem
    best: Found
    random: Design
    errors_db: tuple[float, float, float]
    plateaus: tuple[tuple[float, float], ...]
    evaluations: int

    def table(self) -> Table:
        """The three designs, with units."""
        names, base = self.problem.space.labels, self.problem.space.base
        words = "found", "the thesis' pair", f"best of {self.evaluations} random ones"
        designs = self.best.design, base, self.random
        rows = [
            (word, *(float(value) for value in self.problem.space.numbers(design)), error)
            for word, design, error in zip(words, designs, self.errors_db, strict=True)
        ]
        return Table(("design", *names, "expected error, dB"), rows, (2,) * (len(names) + 1))

    def __str__(self) -> str:
        """The table, and a line for the plateau of each number."""
        lines = [str(self.table()), ""]
        for label, (low, high) in zip(self.problem.space.labels, self.plateaus, strict=True):
            name, unit = label.rsplit(", ", 1)
            lines.append(f"any {name} between {low:.3g} and {high:.3g} {unit} is within 0.1 dB")
        return "\n".join(lines)


def beta_bounds(pitch: float, width: float) -> tuple[float, float]:
    """β, rad/mm², from two zones of a mask of a width, mm, to fringes of two pixels at its edge."""
    return 16 * math.pi / width**2, max(math.pi / (pitch * width), 32 * math.pi / width**2)


@checked
def for_sensor(
    sensor: Sensor,
    *,
    distance: tuple[float | int, float | int] = (3.0, 10.0),
    object_distance: Annotated[Number, quantity("mm", positive=True)] = 250.0,
    object_width: Annotated[Number, quantity("mm", positive=True)] = 180.0,
    noise: SignalNoise | PhotonNoise | None = None,
    wavelength: Annotated[Number, quantity("mm", positive=True)] = _LIGHT,
) -> SensorDesign:
    """Two pitches and their distance for a sensor, in seconds: β of two masks, each at two phases.

    As many frequencies are looked at for any number of pixels (256², see `Quadrant`). Even samples
    within the widest bounds, more of them around the best, then a simplex from the best of these.

    **Arguments**

    - `sensor`: its shorter side is the masks' width.
    - `distance`: from mask to sensor, least and most, mm.
    - `object_distance`, `object_width`: mm; by default the thesis' scene.
    - `noise`: default 30 dB of the captures' variance.
    - `wavelength`: mm.

    The error is that of the best linear reconstruction for a scene whose power falls with the 2.8th
    power of frequency. It knows nothing of a reconstruction that suffers at the sensor's border:
    simulate what is found (`thincam design`).

    **Errors**: ValueError for distances that cross or are not positive.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    print(tc.design.for_sensor(tc.Sensor((60, 80), 40 * um), distance=(3, 6)))
    ```

    **See also**: `find_designs`, `DesignSpace`.
    """
    nearest, farthest = map(float, distance)
    if not float(sensor.pitch) < nearest < farthest < math.inf:
        raise ValueError(
            f"distance = {distance}: give the least and the most in mm, such as (3, 10)"
        )
    given = sensor.pitch, object_distance, object_width, wavelength
    pitch, far, across, light = (float(decimal_value(length)) for length in given)
    width = min(sensor.shape) * pitch
    with watched("designing") as tell, allow("float64"):
        setup = Setup(pitch, width, far, across, noise=noise, prior=PowerLaw(2.8))
        setup = cast(setup, "float64")
        start = min(max(_DISTANCE, nearest), farthest)
        usual = shots(_BETAS, start, _PHASES, wavelength=light, width=width)
        betas = beta_bounds(pitch, width)
        space = DesignSpace(
            usual,
            (
                Variable("beta", *betas, (0, 1)),
                Variable("beta", *betas, (2, 3)),
                Variable("distance", nearest, farthest, (0, 1, 2, 3)),
            ),
        )
        coarse, fine = (
            design_problem(BayesError(), space, setup, phase_pairs(2), FrequencyCounts(exact=n))
            for n in (_COARSE, _FINE)
        )
        return _searched(replace(fine, data=coarse.exact), tell)


def _searched(problem: DesignProblem, tell: Callable[..., None]) -> SensorDesign:
    space, key = problem.space, jax.random.key(0)
    given = problem.objective, space, problem.data
    points, costs = map(np.asarray, sampled(*given, _SAMPLES, key))
    tell(0, 0, _so_far(space, points, costs))
    near = points[np.argsort(costs)[:_BEST]]
    low, high = near.min(axis=0), near.max(axis=0)
    finer = low + (high - low) * points
    every = np.concatenate([points, finer])
    known = np.concatenate([costs, evaluate(*given, jnp.asarray(finer))])
    tell(0, 0, _so_far(space, every, known))
    starts = every[best_apart(every, known, _STARTS)]
    better, more = improved(problem, starts[::-1], ["iterations_exhausted"] * (_STARTS - 1))
    best, count = min(better, key=lambda one: one.objective), len(every) + more
    random = best_random(problem, count, _SAMPLES, jax.random.fold_in(key, 1))
    beside = tuple(np.asarray(space.point(one)) for one in (space.base, random))
    errors = _errors_db(problem, np.stack([best.point, *beside]))
    ends = tuple(_plateau(problem, best, n, errors[0] + PLATEAU_DB) for n in range(space.size))
    return SensorDesign(problem, best, random, tuple(errors.tolist()), ends, count)


def _so_far(space: DesignSpace, points: np.ndarray, costs: np.ndarray) -> str:
    """The best of some points, in words."""
    best = int(np.argmin(costs))
    numbers = space.numbers(space.design(jnp.asarray(points[best])))
    pairs = [
        "{0} {2:.3g} {1}".format(*label.rsplit(", ", 1), float(value))
        for label, value in zip(space.labels, numbers, strict=True)
    ]
    return f"error {10 * math.log10(costs[best]):.2f} dB so far, {', '.join(pairs)}"


def _errors_db(problem: DesignProblem, points: np.ndarray) -> np.ndarray:
    given = problem.objective, problem.space, problem.exact, jnp.asarray(points)
    return 10 * np.log10(np.asarray(evaluate(*given, at_a_time=1), float))


def _plateau(problem: DesignProblem, best: Found, number: int, most: float) -> tuple[float, float]:
    """Values of a free number, the others held, between which the error keeps below a level."""
    lower, upper = (float(end[number]) for end in (problem.space.lower, problem.space.upper))
    ends = []
    for step in (-_STEP, _STEP):
        point = np.array(best.point)
        while 0 <= point[number] + step <= 1:
            point[number] += step
            if not _errors_db(problem, point[None])[0] <= most:
                point[number] -= step
                break
        ends.append(lower + (upper - lower) * float(point[number]))
    return ends[0], ends[1]
