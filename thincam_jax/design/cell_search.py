"""Search for masks whose every cell is free: by gradient, beside random masks, polished by flips.

Each evaluation is exact diffraction of all cells and the error of the best linear image over the
field (`ExpectedError`), with its slope at some four times the cost. A search begins at the best of
random masks, descends by Adam while the levels harden, and flips cells of binary masks, both of
those found and of those it began at, as long as that helps: flips turn one opening into a lens,
where a descent ends in a crowd of worse ones (docs/measured/full_size.md). It can be ended at any
time and goes on from its folder.
"""

import hashlib
import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.files import read_arrays, write_whole
from thincam_jax._core.precision import decimal_value
from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import check_fields, quantity, whole
from thincam_jax._core.table import Table
from thincam_jax.design.cell_masks import (
    CellMasks,
    CellOptics,
    Numbers,
    Transmittances,
    drawn_cells,
    without_lone_cells,
)
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.setup import Setup
from thincam_jax.design.stochastic import adam_method, adam_step
from thincam_jax.lensless.masks.sampled import SampledMask

# Of the sigmoid that hardens, in turn; spread of the numbers at the start; steps between two files.
_STEEPNESS, _SPREAD, _KEPT_EVERY = (2.0, 6.0, 18.0), 0.1, 10
# Points of the field along an axis, and padding, which makes frequencies close: with less a mask
# fits the points and frequencies that it is judged at.
_NODES, _PADDING = 4, 1.25
FLIPPED = "binary", "binary_phase"


@checked
@dataclass(frozen=True)
class CellSettings:
    """Settings of a search for cells.

    - `draws`: random masks.
    - `starts`: how many of the best of these it begins at, to go on from the one that has the least
      error after a quarter of the steps.
    - `steps`: descents' steps at each of three steepnesses.
    - `rate`: change of the numbers a step.
    - `flips`: most evaluations that then flip cells of binary levels, as long as that helps.
    - `lone_cells`: whether a cell may differ from all four beside it, which writers lose first.
    - `depths`: distances of the scene, mm, whose mean error counts, of images made for the middle
      one; by default the setup's alone. Each further one adds a PSF to every step.
    - `seed`: seed for all that is random.
    """

    draws: Annotated[int, whole(1, 100_000)] = 100
    starts: Annotated[int, whole(1, 1_000)] = 3
    steps: Annotated[int, whole(1, 100_000)] = 40
    rate: Annotated[float, quantity(positive=True)] = 0.1
    flips: Annotated[int, whole(0, 100_000)] = 100
    lone_cells: bool = True
    depths: Annotated[tuple[float, ...], quantity("mm", positive=True, many=True)] = ()
    seed: Annotated[int, whole(0)] = 0

    def __post_init__(self):
        check_fields(self)

    @property
    def most(self) -> int:
        """Evaluations of a search at most, a slope counted as three."""
        steps = self.steps * len(_STEEPNESS) + (self.starts - 1) * _trial(self)
        flips = (2 if self.lone_cells else 4) * (self.flips + 1)
        return self.draws + 3 * (steps + flips)


@dataclass(frozen=True, eq=False)
class CellDesign:
    """Masks found, beside the best of the random ones.

    - `space`: the masks searched; `numbers`: those found; `masks`: one of each capture.
    - `error`, `random`: expected errors, as parts of the scene's variance.
    - `history`: logarithm of the error at every step, of soft levels.
    - `evaluations`: how many errors the search took, a slope counted as three.
    """

    space: CellMasks
    numbers: Float[np.ndarray, "capture free"]
    error: float
    random: float
    history: Float[np.ndarray, " step"]
    evaluations: int

    @property
    def masks(self) -> list[SampledMask]:
        return self.space.masks(jnp.asarray(self.numbers))

    def table(self) -> Table:
        """Both errors, dB."""
        rows = [
            (f"found by {self.evaluations} evaluations", 10 * math.log10(self.error)),
            ("best random masks of them", 10 * math.log10(self.random)),
        ]
        return Table(("masks", "expected error, dB"), rows, (2,))

    def __str__(self) -> str:
        return str(self.table())


@checked
def find_cells(
    setup: Setup,
    space: CellMasks,
    settings: CellSettings | None = None,
    *,
    start: Numbers | None = None,
    folder: str | os.PathLike[str] | None = None,
    tolerances: Tolerances | None = None,
) -> CellDesign:
    """Masks of the least expected error for a sensor, a scene and its light.

    **Arguments**

    - `setup`: sensor, scene and noise. `space`: the masks to search.
    - `start`: free numbers to begin at, in place of random masks; positive where open.
    - `folder`: where the search keeps its state, every ten steps; it goes on from there.
    - `tolerances`: standard deviations of what the image is made for, as in `robust_error`: the
      error is then the mean over them. Each that is not 0 adds two PSFs to every step.

    1024² pixels and 262,144 cells take 0.6 s a step on two cores, and 1 GB.

    **Validity**: one wavelength, a scene at one distance, and a PSF that changes over the field
    only by what the sensor cuts off. Judge masks by `capture` and a reconstruction. What is found
    is a local optimum: try seeds.

    **Errors**: ValueError for a folder with another search, and for a start of another shape;
    MemoryError, one line, for more cells than fit.

    ```python
    import thincam_jax as tc
    from thincam_jax.design.cell_masks import CellMasks
    from thincam_jax.design.cell_search import CellSettings, find_cells
    from thincam_jax.units import nm, um

    light = tc.design.PhotonNoise(1e5)
    setup = tc.design.Setup(40 * um, 1.28, 100.0, 40.0, noise=light)
    space = CellMasks(40 * um, 24, distance=3.0, wavelength=500 * nm)
    found = find_cells(setup, space, CellSettings(8, 2, steps=4, flips=2))
    tc.design.write_gds("mask.gds", found.masks[0])
    ```

    **See also**: `limit`, `design.write_gds`.
    """
    settings, tolerances = settings or CellSettings(), tolerances or Tolerances()
    if not settings.lone_cells and (space.rings or space.levels not in FLIPPED):
        raise ValueError("lone_cells=False is for binary levels of cells; leave it out for others")
    problem = _Problem(space, CellJudge.of(setup, space, settings.depths, tolerances, _NODES))
    shape = space.captures, space.free
    if start is not None and np.shape(start) != shape:
        raise ValueError(f"start has shape {np.shape(start)}; give (capture, free) = {shape}")
    file = None if folder is None else Path(folder) / "search.npz"
    described = _described((setup, space, tolerances), settings, start)
    with watched("designing") as tell:
        state = _State.read(file, described)
        if state is None:
            state = problem.begun(settings, start, tell)
        for step in range(len(state.history), settings.steps * len(_STEEPNESS)):
            state = problem.stepped(state, step, settings)
            tell(step, settings.steps * len(_STEEPNESS), _said(state.history[-1]))
            if file is not None and (step + 1) % _KEPT_EVERY == 0:
                state.write(file, described)
        # From where the descent ends, and from its start: either can be the better.
        ends = [problem.flipped(one, settings, tell) for one in (state.numbers, state.start)]
        numbers, error, _ = min(ends, key=lambda end: end[1])
        flips = sum(taken for _, _, taken in ends)
    tried = 0 if start is not None else min(settings.starts, settings.draws) - 1
    slopes = len(state.history) + tried * _trial(settings) + flips
    count = settings.draws + 3 * slopes
    history = np.asarray(state.history)
    return CellDesign(space, np.asarray(numbers), error, state.random, history, count)


def _trial(settings: CellSettings) -> int:
    """Steps of each start."""
    return math.ceil(settings.steps / 4)


def _said(logarithm: float) -> str:
    return f"error {10 / math.log(10) * logarithm:.2f} dB so far"


def _described(problem: Any, settings: CellSettings, start: Any) -> str:
    """All that a search depends on."""
    begun = "" if start is None else hashlib.sha256(np.asarray(start).tobytes()).hexdigest()
    return eqx.tree_pformat(problem, short_arrays=False) + f" {settings} {begun}"


@dataclass(frozen=True, eq=False)
class _State:
    """A descent's numbers, Adam's, the history, where it began, and random masks' least error."""

    numbers: Array
    adam: Any
    history: list[float]
    start: Array
    random: float

    @staticmethod
    def new(numbers: Array, start: Array, random: float) -> "_State":
        return _State(numbers, adam_method().init(numbers), [], start, random)

    def write(self, file: Path, described: str) -> None:
        leaves = map(np.asarray, jax.tree.leaves((self.numbers, self.start, self.adam)))
        named = {f"leaf{n}": leaf for n, leaf in enumerate(leaves)}
        more = {"history": np.asarray(self.history), "random": self.random}
        content = io.BytesIO()
        np.savez(content, described=np.asarray(described), **named, **more)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content.getvalue())

    @staticmethod
    def read(file: Path | None, described: str) -> "_State | None":
        if file is None or not file.exists():
            return None
        try:
            held = read_arrays(file)
            leaves = [jnp.asarray(held[f"leaf{n}"]) for n in range(len(held) - 3)]
            history, random = held["history"].tolist(), float(held["random"])
            same = str(held["described"]) == described
        except Exception as error:  # of a file that anybody may have changed
            raise ValueError(f"{file}: holds no search; give another folder") from error
        if not same:
            raise ValueError(f"{file}: holds a search for other masks; give another folder")
        numbers, start, *rest = leaves
        adam = jax.tree.unflatten(jax.tree.structure(adam_method().init(numbers)), rest)
        return _State(numbers, adam, history, start, random)


class CellJudge(eqx.Module):
    """Expected error of cells' amplitudes, the mean over depths and tolerances.

    - `optics`: those of the middle depth, which images are made for; `moved`: those of other depths
      and of numbers that are off, each with its weight.
    """

    optics: CellOptics
    error: ExpectedError
    moved: tuple[tuple[CellOptics, float], ...]

    @staticmethod
    def of(
        setup: Setup,
        space: CellMasks,
        depths: Sequence[float] = (),
        tolerances: Tolerances | None = None,
        nodes: int = 3,
    ) -> "CellJudge":
        """`depths`: mm; by default the setup's distance. `nodes`: see `ExpectedError`."""
        far, pitch, distance = (
            float(decimal_value(length))
            for length in (setup.object_distance, setup.pitch, space.distance)
        )
        every = sorted(map(float, depths)) or [far]
        focus = every[len(every) // 2]
        optics = CellOptics(space, focus, pitch)
        grids, distances = [optics.grid] * space.captures, [distance] * space.captures
        error = ExpectedError(setup, grids, distances, nodes=nodes, padding=_PADDING)
        moved = [(space, depth, 1 / len(every)) for depth in every if depth != focus]
        moved += [(*one, 0.5) for one in _moved(space, focus, tolerances or Tolerances())]
        others = tuple(
            (CellOptics(one, away, pitch, cells=optics.cells, focus=focus), weight)
            for one, away, weight in moved
        )
        return CellJudge(optics, error, others)

    def __call__(self, amplitudes: Transmittances) -> Float[Array, ""]:
        def psfs(optics: CellOptics):
            return jax.lax.map(jax.checkpoint(lambda a: optics(a)), amplitudes)

        own = psfs(self.optics)
        exact = self.error(own)
        moved = [(self.error(psfs(optics), assumed=own), weight) for optics, weight in self.moved]
        return exact + sum(weight * (one - exact) for one, weight in moved)


class _Problem(eqx.Module):
    space: CellMasks
    judge: CellJudge

    def logarithm(self, parts: Numbers) -> Float[Array, ""]:
        """The error's logarithm at levels of cells."""
        return jnp.log(self.judge(self.space.amplitudes(parts)))

    def begun(
        self, settings: CellSettings, start: Numbers | None, tell: Callable[..., None]
    ) -> _State:
        """The best of starts after a quarter of the steps at the first steepness."""
        rng, values, states = np.random.default_rng(settings.seed), [], []
        drawn = [drawn_cells(self.space, rng) for _ in range(settings.draws)]
        for cells in drawn:
            values.append(float(_logarithm(self, jnp.asarray(cells, float))))
            tell(len(values), len(drawn), _said(np.fmin.reduce(values)))
        best = np.argsort(values, kind="stable")[: settings.starts]
        random = math.exp(values[best[0]])
        starts = [drawn[n] - 0.5 for n in best] if start is None else [np.asarray(start, float)]
        for numbers in starts:
            begun = numbers + _SPREAD * rng.normal(size=numbers.shape)
            state = _State.new(jnp.asarray(begun, float), jnp.asarray(starts[0], float), random)
            for step in range(_trial(settings)):
                state = self.stepped(state, step, settings)
            states.append(state)
            tell(0, 0, _said(min(one.history[-1] for one in states)))
        return min(states, key=lambda one: one.history[-1])

    def stepped(self, state: _State, step: int, settings: CellSettings) -> _State:
        """A step of Adam's; the rate falls to zero as a cosine at each steepness."""
        place = (step % settings.steps) / settings.steps
        rate = settings.rate * 0.5 * (1 + math.cos(math.pi * place))
        steepness = _STEEPNESS[step // settings.steps]
        pair = jnp.asarray([steepness, rate], state.numbers.dtype)  # traced: one program for all
        numbers, adam, value = _adam_step(self, state.numbers, state.adam, pair)
        history = [*state.history, float(value)]
        return replace(state, numbers=numbers, adam=adam, history=history)

    def flipped(
        self, numbers: Array, settings: CellSettings, tell: Callable[..., None] = lambda *said: None
    ) -> tuple[Array, float, int]:
        """Numbers as they are made, their error, and how many slopes were taken.

        The cells that promise most are flipped together; where that fails, half as many. Without
        lone cells it begins where it ends with them.
        """
        before = 0
        if not settings.lone_cells:
            numbers, _, before = self.flipped(numbers, replace(settings, lone_cells=True), tell)

        def made(parts: Array) -> Array:
            if settings.lone_cells:
                return parts
            cells = parts.reshape(-1, *(self.space.count,) * 2)
            return without_lone_cells(cells).reshape(parts.shape)

        parts = made(self.space.parts(numbers))
        value, slope = _slope(self, parts)
        if self.space.levels not in FLIPPED:
            return numbers, math.exp(float(value)), 1
        several = max(1, parts.size // 100)
        for taken in range(settings.flips):
            promise = (slope * (1 - 2 * parts)).ravel()
            several = min(several, int(jnp.sum(promise < 0)))
            if several == 0:
                return parts - 0.5, math.exp(float(value)), before + taken + 1
            chosen = jnp.argsort(promise)[:several]
            other = parts.ravel().at[chosen].set(1 - parts.ravel()[chosen])
            other = made(other.reshape(parts.shape))
            new, new_slope = _slope(self, other)
            tell(taken, settings.flips, _said(min(float(new), float(value))))
            if new < value:
                parts, value, slope = other, new, new_slope
            else:
                several //= 2
        return parts - 0.5, math.exp(float(value)), before + settings.flips + 1


def _moved(
    space: CellMasks, far: float, tolerances: Tolerances
) -> Iterator[tuple[CellMasks, float]]:
    """Masks and distance of the object with one number moved, either way."""
    if tolerances.beta:
        raise ValueError("cells have no β; give tolerances without beta")
    away = tolerances.distance, tolerances.tilt * float(space.width) / math.sqrt(12)
    for sign in (-1, 1):
        for size in filter(None, away):
            yield space.replace(distance=space.distance + sign * size), far
        if tolerances.wavelength:
            yield space.replace(wavelength=space.wavelength + sign * tolerances.wavelength), far
        if tolerances.object_distance:
            yield space, far + sign * tolerances.object_distance


@eqx.filter_jit
def _logarithm(problem: _Problem, parts: Numbers) -> Float[Array, ""]:
    return problem.logarithm(parts)


@eqx.filter_jit
def _slope(problem: _Problem, parts: Numbers) -> tuple[Float[Array, ""], Numbers]:
    return jax.value_and_grad(problem.logarithm)(parts)


@eqx.filter_jit
def _adam_step(problem: _Problem, numbers: Numbers, adam: Any, pair: Float[Array, "2"]):
    """`pair`: steepness and rate."""

    def cost(free):
        return problem.logarithm(problem.space.parts(free, pair[0])), None

    numbers, adam, _, (value, _) = adam_step(cost, numbers, adam, pair[1], adam_method())
    return numbers, adam, value
