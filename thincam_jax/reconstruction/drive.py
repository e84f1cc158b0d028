"""Running an iterative method: from chunk to chunk, looking up in between.

An iteration is compiled; what stands between two chunks of iterations is not, so that it can
report, stop early, adapt and be interrupted. Chunks are unrolled: on a CPU, XLA runs the transforms
of a compiled loop on one core and those of a straight program on all (docs/reconstruction.md has
the comparison).
"""

import abc
import math
import time
from collections.abc import Callable
from typing import Generic, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Method_State = TypeVar("Method_State")
Status = Literal["converged", "iterations_exhausted", "stopped", "interrupted", "non_finite"]


class Residuals(NamedTuple):
    """How far an iteration is from its end, each relative to what it is a residual of.

    - `parts`: the same of each of several splits, for methods that weigh them.
    - `members`: the same of each of several problems that are iterated apart.
    """

    primal: float
    dual: float
    parts: tuple[tuple[float, float], ...] = ()
    members: tuple["Residuals", ...] = ()


class Progress(NamedTuple):
    """What a callback sees, and the history keeps.

    - `objective`: of the image; summed over a batch.
    - `primal`, `dual`: relative residuals, see the method; NaN where it has none.
    """

    iteration: int
    objective: float
    primal: float
    dual: float


class Outcome(NamedTuple):
    """The image with the lowest objective among those looked at, and how it came about."""

    image: Float[Array, "*batch channel plane y x"]
    status: Status
    history: tuple[Progress, ...]
    iterations: int
    seconds: float


class AbstractMethod(eqx.Module, Generic[Method_State]):
    """An iterative method with its problem, as `drive` wants it."""

    @abc.abstractmethod
    def start(self, image: Float[Array, "*batch channel plane y x"]) -> Method_State:
        """The state of an image."""

    @abc.abstractmethod
    def advance(self, state: Method_State, count: int) -> Method_State:
        """`count` iterations on; the state given is used up."""

    @abc.abstractmethod
    def image(self, state: Method_State) -> Float[Array, "*batch channel plane y x"]:
        """The image that a state stands for."""

    @abc.abstractmethod
    def objective(self, image: Float[Array, "*batch channel plane y x"]) -> Float[Array, "*batch"]:
        """What is to be small."""

    @abc.abstractmethod
    def look(self, state: Method_State) -> tuple[Method_State, Residuals]:
        """One iteration on, with its residuals."""

    def adapt(
        self, state: Method_State, residuals: Residuals
    ) -> tuple["AbstractMethod[Method_State]", Method_State]:
        """The method and the state, with parameters fitted to the course so far."""
        return self, state


Callback = Callable[[Progress], object]

# With the iteration that is looked at, ten. Each run of a program gets its memory anew from the
# system, which takes time for large windows: shared by nine iterations it does not matter.
CHUNK = 9
LOOK_EVERY = CHUNK + 1


def drive(
    method: AbstractMethod,
    image: Float[Array, "*batch channel plane y x"],
    *,
    iterations: int,
    tolerance: float,
    look_every: int = LOOK_EVERY,
    adapt_until: int = 0,
    callback: Callback | None = None,
    done: int = 0,
) -> Outcome:
    """Iterate until both residuals are below `tolerance`, or `iterations` are done.

    Every `look_every` iterations the objective and the residuals are taken, `callback` is called
    (a true answer stops the run) and, up to iteration `adapt_until`, the method may adapt as long
    as the objective falls: parameters that follow misleading residuals would spoil it. Ctrl-C ends
    the run with what was best until then. Iterations count from `done`, those of a run before.
    """
    began = time.perf_counter()
    best, history = image, [_look_at(method, image, done)]
    status: Status = "iterations_exhausted"
    try:
        state = method.start(image)
        while done < iterations:
            plain = min(look_every, iterations - done) - 1
            state, residuals = method.look(_advance(method, state, plain))
            done += plain + 1
            current = method.image(state)
            progress = Progress(done, float(jnp.sum(method.objective(current))), *residuals[:2])
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


def _advance(method: AbstractMethod, state, count: int):
    for size in [CHUNK] * (count // CHUNK) + [1] * (count % CHUNK):
        state = method.advance(state, size)
    return state


def _look_at(method: AbstractMethod, image, done: int) -> Progress:
    nan = math.nan
    return Progress(done, float(jnp.sum(method.objective(image))), nan, nan)
