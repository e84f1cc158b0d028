"""Iterate a method in compiled chunks, checking convergence between them.

Between two chunks of iterations a run can report, stop early, adapt and be interrupted. A chunk is
one compiled loop: a straight program of ten iterations takes as long to run and twice as long to
compile (docs/decisions/programs_of_ten.md).
"""

import abc
import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.reconstruction.regularisers import Image

Method_State = TypeVar("Method_State")

Status = Literal["converged", "iterations_exhausted", "stopped", "interrupted", "non_finite"]


@dataclass(frozen=True)
class Residuals:
    """Relative residuals of an iteration.

    - `parts`: (primal, dual) of each split, for methods that balance them.
    - `elements`: the residuals of each problem that is iterated in parallel.
    """

    primal: float
    dual: float
    parts: tuple[tuple[float, float], ...] = ()
    elements: tuple["Residuals", ...] = ()


@dataclass(frozen=True)
class Progress:
    """Progress of a run, for its callback and its history.

    - `objective`: objective of the image, summed over a batch.
    - `primal`, `dual`: relative residuals, see the method; NaN if it has none.
    """

    iteration: int
    objective: float
    primal: float
    dual: float


class Outcome(eqx.Module):
    """The image with the lowest objective among those checked, and the history of the run.

    - `reason`: note about the result for the user; "" for none.
    """

    image: Image
    status: Status
    history: tuple[Progress, ...]
    iterations: int
    seconds: float
    reason: str = ""

    def followed_by(self, second: "Outcome") -> "Outcome":
        """The outcome of a run that went on with this one's image, with both histories.

        A run that counted anew is counted on from this one's iterations.
        """
        done = self.iterations - second.history[0].iteration
        later = (dataclasses.replace(p, iteration=p.iteration + done) for p in second.history[1:])
        return dataclasses.replace(
            second,
            history=(*self.history, *later),
            iterations=second.iterations + done,
            seconds=self.seconds + second.seconds,
        )


class AbstractMethod(eqx.Module, Generic[Method_State]):
    """An iterative method with its problem, for `iterate`."""

    @abc.abstractmethod
    def start(self, image: Image) -> Method_State:
        """The state of a start image."""

    @abc.abstractmethod
    def advance(self, state: Method_State, count: int) -> Method_State:
        """The state after `count` more iterations; the state given must not be used again."""

    def advance_unjudged(self, state: Method_State, count: int) -> Method_State:
        """The state after as many more, by some methods without residuals to ask for."""
        return self.advance(state, count)

    @abc.abstractmethod
    def image(self, state: Method_State) -> Image:
        """The image of a state."""

    @abc.abstractmethod
    def objective(self, image: Image) -> Float[Array, "*batch"]:
        """Objective to minimise."""

    @abc.abstractmethod
    def residuals(self, state: Method_State) -> Residuals:
        """Residuals of the last iteration."""

    def adapt(
        self, state: Method_State, residuals: Residuals
    ) -> tuple["AbstractMethod[Method_State]", Method_State]:
        """The method and the state after adapting the method's parameters to the residuals."""
        return self, state


class SolverState(eqx.Module):
    """Iterate of an optimistix solver: y, and the solver's own state."""

    value: PyTree[Array]
    inside: Any


class OptimistixMethod(AbstractMethod[SolverState]):
    """A method that iterates by the steps of an optimistix solver.

    The solver is stepped through its interactive interface, `init`, `step` and `postprocess`;
    `optimistix.fixed_point` and `optimistix.minimise` run the same object in one compiled loop. The
    solver's state has the residuals `primal` and `dual`, and `parts` if it has several splits.

    - `solver`, and `arguments` of its function.
    - `donated`: whether the next state reuses the memory of the last.
    - `judging`: whether the solver finds the residuals of its steps.
    """

    solver: eqx.AbstractVar[Any]
    arguments: eqx.AbstractVar[Any]
    donated: ClassVar[bool] = False
    judging: ClassVar[bool] = True

    @staticmethod
    @abc.abstractmethod
    def function(value: PyTree[Array], arguments: Any) -> tuple[Any, None]:
        """The function to solve, without auxiliary output."""

    @abc.abstractmethod
    def value_of(self, image: Image) -> PyTree[Array]:
        """y of an image."""

    @abc.abstractmethod
    def image_of(self, value: PyTree[Array]) -> Image:
        """The image of a y."""

    def start(self, image: Image):
        return _start(self, image)

    def advance(self, state: SolverState, count: int):
        run = _advance_donated if self.donated else _advance
        return run(self, state, np.int32(count))

    def image(self, state: SolverState):
        return _image(self, state)

    def residuals(self, state: SolverState):
        inside = jax.device_get(state.inside)
        parts = tuple((float(p), float(d)) for p, d in getattr(inside, "parts", ()))
        return Residuals(float(inside.primal), float(inside.dual), parts)


Callback = Callable[[Progress], object]

# Iterations between two checks.
CHUNK = 10


@dataclass(frozen=True)
class Schedule:
    """When a run is checked, adapted and ended.

    - `iterations`: at most, counted from `done`, those of an earlier run.
    - `tolerance`: both residuals must fall below it, see also `settled`.
    - `check_every`: iterations between two checks.
    - `adapt_until`: last iteration after which the method may adapt.
    - `settled`: a run has also converged if the objective changed by less than this share of it
      over the last two intervals between checks.
    - `still`: or if the image changed by less than this share of it over the last interval, and the
      objective by less than half of that.
    - `rising`: a run that is not still ends, not converged, if from its second check on the
      objective is above the lowest one by more than this share, and has not fallen by as much since
      the last check.
    - `judged`: whether residuals are looked at after `adapt_until` as well.
    """

    iterations: int
    tolerance: float
    check_every: int = CHUNK
    adapt_until: int = 0
    done: int = 0
    settled: float = 0.0
    still: float = 0.0
    rising: float = 0.0
    judged: bool = True


def iterate(
    method: AbstractMethod,
    image: Image,
    schedule: Schedule,
    *,
    callback: Callback | None = None,
    objective: Callable[[Image], Float[Array, "*batch"]] | None = None,
) -> Outcome:
    """Iterate from a start image until both residuals are small, or the iterations exhausted.

    At each check the objective and the residuals are computed, `callback` is called (it stops the
    run by returning a true value), and the method may adapt while the objective falls: parameters
    that follow misleading residuals would spoil it. Ctrl-C ends the run with the best image so far.

    - `objective`: by which images are compared; default that of the method.
    """
    done = schedule.done
    began = time.perf_counter()

    def judged(image) -> float:
        return float(np.sum(np.asarray((objective or method.objective)(image))))

    best, last, history = image, image, [Progress(done, judged(image), math.nan, math.nan)]
    status: Status = "iterations_exhausted"
    try:
        state = method.start(image)
        while done < schedule.iterations:
            count = min(schedule.check_every, schedule.iterations - done)
            is_judged = schedule.judged or done < schedule.adapt_until
            state = (method.advance if is_judged else method.advance_unjudged)(state, count)
            done += count
            residuals = method.residuals(state) if is_judged else Residuals(math.nan, math.nan)
            current = method.image(state)
            progress = Progress(done, judged(current), residuals.primal, residuals.dual)
            if not math.isfinite(progress.objective):
                status = "non_finite"
                break
            falling = progress.objective <= min(p.objective for p in history)
            if falling:
                best = current
            history.append(progress)
            small = max(progress.primal, progress.dual) < schedule.tolerance
            is_stopped = callback is not None and callback(progress)
            still = schedule.still > 0 and _is_still(history, last, current, schedule.still)
            last = current
            is_rising = schedule.rising > 0 and _is_rising(history, schedule.rising)
            if is_rising and not (still or is_stopped):
                break
            if small or still or _settled(history, schedule.settled):
                status = "converged"
                break
            if is_stopped:
                status = "stopped"
                break
            if done <= schedule.adapt_until and falling:
                method, state = method.adapt(state, residuals)
    except KeyboardInterrupt:
        status = "interrupted"
    seconds = time.perf_counter() - began
    return Outcome(best, status, tuple(history), done, seconds)


def _settled(history: Sequence[Progress], share: float) -> bool:
    """Whether the objective hardly changed over the last two intervals between checks."""
    last = [p.objective for p in history[-3:]]
    return len(history) > 3 and max(last) - min(last) < share * last[-1]


def _is_rising(history: Sequence[Progress], share: float) -> bool:
    """Whether the last of three objectives or more is above the lowest one, and stays so.

    One that fell by more than it is above is below after as many iterations more.
    """
    *before, last = (p.objective for p in history)
    above = last - min(before)
    return len(before) > 1 and above > share * min(before) and before[-1] - last < above


def _is_still(history: Sequence[Progress], before: Image, after: Image, share: float) -> bool:
    """Whether image and objective hardly changed; on the host, where nothing is compiled."""
    first, last = (p.objective for p in history[-2:])
    old, new = (np.ravel(np.asarray(image)) for image in (before, after))
    moved, size = (float(np.linalg.norm(one)) for one in (new - old, new))
    return moved <= share * size and abs(last - first) <= share / 2 * abs(last)


@quickly_compiled
def _start(method: OptimistixMethod, image) -> SolverState:
    value = method.value_of(image)
    structure, nothing = jax.eval_shape(method.function, value, method.arguments)
    tags = frozenset()
    inside = method.solver.init(
        method.function, value, method.arguments, {}, structure, nothing, tags
    )
    return SolverState(value, inside)


def _steps(method: OptimistixMethod, state: SolverState, count: Any) -> SolverState:
    """`count` steps: a loop of any length; if the solver judges, the last step is outside of it.

    What a solver computes for its residuals only, the compiler drops from the loop.
    """

    def step(_, state):
        value, inside, _ = method.solver.step(
            method.function, state.value, method.arguments, {}, state.inside, frozenset()
        )
        return SolverState(value, inside)

    if not method.judging:
        return jax.lax.fori_loop(0, count, step, state)
    return step(0, jax.lax.fori_loop(1, count, step, state))


_advance = eqx.filter_jit(_steps)

_advance_donated = eqx.filter_jit(_steps, donate="all-except-first")


@eqx.filter_jit
def _image(method: OptimistixMethod, state: SolverState):
    value, _, _ = method.solver.postprocess(
        *(method.function, state.value, None, method.arguments, {}, state.inside, frozenset()),
        optimistix.RESULTS.successful,
    )
    return method.image_of(value)


def outcome_of_run(
    start: Float[Array, "..."],
    image: Image,
    objectives: Sequence[Array],
    *,
    converged: bool,
    iterations: int,
    began: float,
) -> Outcome:
    """Outcome of a run in one compiled program, without progress.

    As with `iterate`, the image is the start if the result is not finite.

    - `objectives`: objectives of both images, summed over a batch here.
    - `began`: `time.perf_counter()` at the start.
    """
    nan = math.nan
    before, after = (
        Progress(n, float(np.sum(value)), nan, nan)
        for n, value in zip((0, iterations), objectives, strict=True)
    )
    # From captures with NaN a linear solver may return a clean zero.
    finite = bool(jnp.isfinite(image).all()) and math.isfinite(after.objective)
    status: Status = "converged" if converged else "iterations_exhausted"
    return Outcome(
        image if finite else jnp.broadcast_to(start, image.shape),
        status if finite else "non_finite",
        (before, after),
        iterations,
        time.perf_counter() - began,
    )
