"""Running an iterative method: from chunk to chunk, looking up in between.

An iteration is compiled; what stands between two chunks of iterations is not, so that it can
report, stop early, adapt and be interrupted. Chunks are unrolled: on a CPU, XLA runs the transforms
of a compiled loop on one core and those of a straight program on all (docs/solver_figures.md has
the comparison).
"""

import abc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax.reconstruction.regularisers import Image

Method_State = TypeVar("Method_State")
Status = Literal["converged", "iterations_exhausted", "stopped", "interrupted", "non_finite"]


@dataclass(frozen=True)
class Residuals:
    """How far an iteration is from its end, each relative to what it is a residual of.

    - `parts`: the same of each of several splits, for methods that weigh them.
    - `apart`: the same of each of several problems that are iterated apart.
    """

    primal: float
    dual: float
    parts: tuple[tuple[float, float], ...] = ()
    apart: tuple["Residuals", ...] = ()


@dataclass(frozen=True)
class Progress:
    """What a callback sees, and the history keeps.

    - `objective`: of the image; summed over a batch.
    - `primal`, `dual`: relative residuals, see the method; NaN where it has none.
    """

    iteration: int
    objective: float
    primal: float
    dual: float


class Outcome(eqx.Module):
    """The image with the lowest objective among those looked at, and how it came about."""

    image: Image
    status: Status
    history: tuple[Progress, ...]
    iterations: int
    seconds: float


class AbstractMethod(eqx.Module, Generic[Method_State]):
    """An iterative method with its problem, as `drive` wants it."""

    @abc.abstractmethod
    def start(self, image: Image) -> Method_State:
        """The state of an image."""

    @abc.abstractmethod
    def advance(self, state: Method_State, count: int) -> Method_State:
        """`count` iterations on; the state given is used up."""

    @abc.abstractmethod
    def image(self, state: Method_State) -> Image:
        """The image that a state stands for."""

    @abc.abstractmethod
    def objective(self, image: Image) -> Float[Array, "*batch"]:
        """What is to be small."""

    @abc.abstractmethod
    def residuals(self, state: Method_State) -> Residuals:
        """Those of the last iteration."""

    def adapt(
        self, state: Method_State, residuals: Residuals
    ) -> tuple["AbstractMethod[Method_State]", Method_State]:
        """The method and the state, with parameters fitted to the course so far."""
        return self, state


class Running(eqx.Module):
    """Where a solver of optimistix stands: y, and its own state."""

    value: PyTree[Array]
    inside: Any


class OptimistixMethod(AbstractMethod[Running]):
    """A method whose iterations are those of a solver of optimistix.

    The solver is stepped from outside through its interactive interface, `init`, `step` and
    `postprocess`; `optimistix.fixed_point` and `optimistix.minimise` run the same object in one
    compiled loop. The solver's state has `primal` and `dual`, and `parts` where it has several.

    - `solver`, and `arguments` of its function.
    - `donated`: whether the memory of a state is used again for the next one.
    """

    solver: eqx.AbstractVar[Any]
    arguments: eqx.AbstractVar[Any]
    donated: ClassVar[bool] = False

    @staticmethod
    @abc.abstractmethod
    def function(value: PyTree[Array], arguments: Any) -> tuple[Any, None]:
        """What the solver is to solve, and nothing beside it."""

    @abc.abstractmethod
    def value_of(self, image: Image) -> PyTree[Array]:
        """y of an image."""

    @abc.abstractmethod
    def image_of(self, value: PyTree[Array]) -> Image:
        """The image of a y."""

    def start(self, image: Image):
        return _start(self, image)

    def advance(self, state: Running, count: int):
        run = _advance_donated if self.donated else _advance
        for size in [UNROLLED] * (count // UNROLLED) + [1] * (count % UNROLLED):
            state = run(self, state, size)
        return state

    def image(self, state: Running):
        return _image(self, state)

    def residuals(self, state: Running):
        inside = jax.device_get(state.inside)
        parts = tuple((float(p), float(d)) for p, d in getattr(inside, "parts", ()))
        return Residuals(float(inside.primal), float(inside.dual), parts)


Callback = Callable[[Progress], object]

# Iterations between two looks.
CHUNK = 10
# Iterations in one program. Each run of a program gets its memory anew from the system, which takes
# time for large windows: shared by ten iterations it does not matter. Fewer compile sooner.
UNROLLED = CHUNK


def drive(
    method: AbstractMethod,
    image: Image,
    *,
    iterations: int,
    tolerance: float,
    look_every: int = CHUNK,
    adapt_until: int = 0,
    callback: Callback | None = None,
    done: int = 0,
    objective: Callable[[Image], Float[Array, "*batch"]] | None = None,
) -> Outcome:
    """Iterate until both residuals are below `tolerance`, or `iterations` are done.

    Every `look_every` iterations the objective and the residuals are taken, `callback` is called
    (a true answer stops the run) and, up to iteration `adapt_until`, the method may adapt as long
    as the objective falls: parameters that follow misleading residuals would spoil it. Ctrl-C ends
    the run with what was best until then. Iterations count from `done`, those of a run before.
    `objective`: that images are judged by, in place of the method's.
    """
    began = time.perf_counter()

    def judged(image) -> float:
        return float(jnp.sum((objective or method.objective)(image)))

    best, history = image, [Progress(done, judged(image), math.nan, math.nan)]
    status: Status = "iterations_exhausted"
    try:
        state = method.start(image)
        while done < iterations:
            count = min(look_every, iterations - done)
            state = method.advance(state, count)
            done += count
            residuals, current = method.residuals(state), method.image(state)
            progress = Progress(done, judged(current), residuals.primal, residuals.dual)
            if not math.isfinite(progress.objective):
                status = "non_finite"
                break
            falling = progress.objective <= min(p.objective for p in history)
            if falling:
                best = current
            history.append(progress)
            if max(progress.primal, progress.dual) < tolerance:
                status = "converged"
                break
            if callback is not None and callback(progress):
                status = "stopped"
                break
            if done <= adapt_until and falling:
                method, state = method.adapt(state, residuals)
    except KeyboardInterrupt:
        status = "interrupted"
    return Outcome(best, status, tuple(history), done, time.perf_counter() - began)


@eqx.filter_jit
def _start(method: OptimistixMethod, image) -> Running:
    value = method.value_of(image)
    structure, nothing = jax.eval_shape(method.function, value, method.arguments)
    tags = frozenset()
    inside = method.solver.init(
        method.function, value, method.arguments, {}, structure, nothing, tags
    )
    return Running(value, inside)


def _steps(method: OptimistixMethod, state: Running, count: int) -> Running:
    for _ in range(count):
        value, inside, _ = method.solver.step(
            method.function, state.value, method.arguments, {}, state.inside, frozenset()
        )
        state = Running(value, inside)
    return state


_advance = eqx.filter_jit(_steps)
_advance_donated = eqx.filter_jit(_steps, donate="all-except-first")


@eqx.filter_jit
def _image(method: OptimistixMethod, state: Running):
    value, _, _ = method.solver.postprocess(
        *(method.function, state.value, None, method.arguments, {}, state.inside, frozenset()),
        optimistix.RESULTS.successful,
    )
    return method.image_of(value)


def concluded(
    start: Image,
    image: Image,
    objective: Callable[[Array], Array],
    *,
    converged: bool,
    iterations: int,
    began: float,
) -> Outcome:
    """The outcome of a method that runs to its end in one piece.

    What `drive` would say: the objective before and after, and the start where the end is NaN.

    - `began`: `time.perf_counter()` at the start.
    """
    nan = math.nan
    before, after = (
        Progress(n, float(jnp.sum(objective(x))), nan, nan)
        for n, x in ((0, start), (iterations, image))
    )
    # Of captures that hold NaN a linear solver may return a clean zero.
    finite = bool(jnp.isfinite(image).all()) and math.isfinite(after.objective)
    status: Status = "converged" if converged else "iterations_exhausted"
    return Outcome(
        image if finite else start,
        status if finite else "non_finite",
        (before, after),
        iterations,
        time.perf_counter() - began,
    )
