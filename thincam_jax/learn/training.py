"""Training of a model of any kind: Adam with checks, the best kept, and states to go on from.

Every step has the key of its number, and what is done depends on the number of the step alone,
never on the clock: training that goes on from a state ends with the same bits.
"""

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import check_fields, quantity, whole
from thincam_jax.design.stochastic import adam_method, adam_step
from thincam_jax.learn.checkpoint import (
    CheckpointError,
    difference,
    read_arrays,
    read_description,
    write_arrays,
)

# Steps in a row that give NaN, after which training goes back; and how often it does.
_IN_A_ROW, _MOST_RETREATS = 3, 4
# Steps whose times tell what is left.
_RECENT = 20
_COUNTS = ("step", "skipped", "retreats")
NETWORK = "network.thincam"  # the best one until now, in the folder of a training

TrainingStatus = Literal["finished", "stopped", "diverged"]


@checked
@dataclass(frozen=True)
class TrainingOptions:
    """Length and rate of a training.

    - `steps`, `seed`: number of steps of the training, and its seed.
    - `rate`: step size of Adam; it rises over `warm_up` steps and falls to zero as a cosine, over
      the last `falling` part of the steps.
    - `longest_slope`: norm to which longer gradients are shortened.
    - `averaging`: decay of the running mean of the weights, which is judged and kept, over some
      1/(1 − averaging) steps; 0: the weights themselves.
    - `check_every`: steps between two states that are judged and kept.

    **Errors**: ValueError for numbers out of range.
    """

    steps: Annotated[int, whole(1, 1_000_000)] = 2000
    rate: Annotated[float, quantity(positive=True)] = 1e-3
    warm_up: Annotated[int, whole(0)] = 50
    longest_slope: Annotated[float, quantity(positive=True)] = 1.0
    averaging: Annotated[float, quantity(least=0.0, most=0.999999)] = 0.99
    check_every: Annotated[int, whole(1, 1_000_000)] = 100
    seed: int = 0
    falling: Annotated[float, quantity(positive=True, most=1.0)] = 1.0

    def __post_init__(self):
        check_fields(self)

    def rate_at(self, step: int) -> float:
        """Step size of the step of that number, counted from 0."""
        rising = min(1.0, (step + 1) / (self.warm_up + 1))
        place = max(0.0, (step / self.steps - 1 + self.falling) / self.falling)
        return self.rate * rising * 0.5 * (1 + math.cos(math.pi * place))


@dataclass(frozen=True, eq=False)
class Task:
    """Learning task; floating arrays of the model are trained.

    - `draw`: examples for a step, from its key; the same key gives the same ones.
    - `loss`: (model, examples) → a number and a dictionary of its parts, for `grad`, at module
      level; it is compiled once.
    - `validation`: examples whose mean loss judges the model.
    """

    draw: Callable[[Any], Any]
    loss: Callable[[Any, Any], tuple[Any, dict[str, Any]]]
    validation: Sequence[Any] = ()


class TrainingState(eqx.Module):
    """All that a training goes on from.

    - `weights`, `optimiser`: after `step` steps; `averaged`, `best`: the running mean, and the one
      with the lowest score.
    - `losses`: loss of each step, NaN for those to come and for what was none; `scores`: score of
      each check.
    - `skipped`: steps that changed nothing; `retreats`: how often the rate was halved.
    """

    weights: Any
    optimiser: Any
    averaged: Any
    best: Any
    losses: np.ndarray
    scores: np.ndarray
    step: int = 0
    skipped: int = 0
    retreats: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Steps done, steps that changed nothing, and retreats, for records of the training."""
        return {"steps": self.step, "skipped": self.skipped, "retreats": self.retreats}

    @property
    def record(self) -> dict[str, Any]:
        """The counts, and the scores until now."""
        scores = [round(float(score), 5) for score in self.scores if score == score]
        return {**self.counts, "scores": scores}

    @classmethod
    def begin(cls, model: Any, options: TrainingOptions) -> "TrainingState":
        """State before the first step."""
        # A plain number's weak type would be compiled for once more: steps return none.
        weights = jax.tree.map(
            lambda x: jax.lax.convert_element_type(x, x.dtype),
            eqx.filter(model, eqx.is_inexact_array),
        )
        checked = -(-options.steps // options.check_every)
        losses, scores = (np.full(n, np.nan) for n in (options.steps, checked))
        first = adam_method(options.longest_slope).init(weights)
        return cls(weights, first, weights, weights, losses, scores)


@dataclass(frozen=True)
class TrainingProgress:
    """Progress, reported after every step.

    - `score`: the lowest so far, NaN before the first check; `seconds_left`: estimated.
    """

    step: int
    steps: int
    loss: float
    parts: dict[str, float]
    score: float
    seconds_left: float


class Trained(eqx.Module):
    """The model with the best weights, and the state at the end.

    - `status`: "finished", "stopped" by the callback, or "diverged": NaN again and again, at
      half the rate, too. The best weights until then are kept in each case.
    """

    model: Any
    state: TrainingState
    status: TrainingStatus


def train_model(
    task: Task,
    model: Any,
    options: TrainingOptions,
    *,
    state: TrainingState | None = None,
    keep: Callable[[TrainingState], object] | None = None,
    callback: Callable[[TrainingProgress], object] | None = None,
) -> Trained:
    """Adam on examples that are drawn anew at every step.

    **Arguments**

    - `state`: state to go on from, as `keep` was given it; the result has the same bits as without
      the interruption, on one machine.
    - `keep`: called with every state that is worth to be kept, at each check.
    - `callback`: called after every step; a true answer stops.

    A step that gives NaN is skipped. After three in a row training goes back to the last state
    that was kept, at half the rate and with other examples; after four such retreats it ends.
    """
    fixed = eqx.filter(model, eqx.is_inexact_array, inverse=True)
    key = jax.random.key(options.seed)
    good = state = TrainingState.begin(model, options) if state is None else state
    losses, bad, seconds = state.losses.copy(), 0, []
    status: TrainingStatus = "finished"
    while state.step < options.steps:
        began, number = time.perf_counter(), state.step
        step_key = jax.random.fold_in(jax.random.fold_in(key, number), state.retreats)
        rate = options.rate_at(number) * 0.5**state.retreats
        # The mean begins with what has been seen.
        averaging = min(options.averaging, (1 + number) / (10 + number))
        carried = (state.weights, state.optimiser, state.averaged)
        given = (fixed, carried, task.draw(step_key), jnp.asarray((rate, averaging)))
        carried, usable, loss, parts = _step(task.loss, options.longest_slope, *given)
        losses[number], bad = float(loss), 0 if usable else bad + 1
        counts = (number + 1, state.skipped + int(bad > 0), state.retreats)
        state = TrainingState(*carried, state.best, state.losses, state.scores, *counts)
        if bad == _IN_A_ROW:
            state = replace(good, skipped=state.skipped, retreats=state.retreats + 1)
            bad = 0
            if state.retreats > _MOST_RETREATS:
                status = "diverged"
                break
        elif not bad and (state.step % options.check_every == 0 or state.step == options.steps):
            state = good = _judged(task, fixed, state, losses, options)
            if keep is not None:
                keep(good)
        seconds = [*seconds[-_RECENT:], time.perf_counter() - began]
        if callback is not None:
            left = float(np.median(seconds)) * (options.steps - state.step)
            numbers = {name: float(part) for name, part in parts.items()}
            progress = (state.step, options.steps, float(loss), numbers, _lowest(state), left)
            if callback(TrainingProgress(*progress)):
                status = "stopped"
                break
    return Trained(eqx.combine(state.best, fixed), state, status)


@dataclass(frozen=True, eq=False)
class TrainingFiles:
    """Files that a training goes on from, written at each check, whole or not at all.

    - `state`: path of the state, which belongs to the `settings`. From one that is there training
      ends with the same bits as without the interruption, on one machine.
    - `save`: writes the best network of a state.
    """

    state: Path
    settings: dict[str, Any]
    save: Callable[[TrainingState], object]

    def keep(self, state: TrainingState) -> None:
        """Write the network, and last the state: it is what training goes on from."""
        self.save(state)
        write_state(self.state, state, self.settings)

    def train(self, task: Task, model: Any, options: TrainingOptions, callback: Any) -> Trained:
        """`train_model`; CheckpointError for a state that is damaged or of another training."""
        state = TrainingState.begin(model, options)
        if self.state.exists():
            state = read_state(self.state, state, self.settings)
        return train_model(task, model, options, state=state, keep=self.keep, callback=callback)


def write_state(
    path: str | os.PathLike[str], state: TrainingState, settings: dict[str, Any]
) -> Path:
    """A state to go on from, and the settings that it belongs to; whole or not at all."""
    counts = {name: getattr(state, name) for name in _COUNTS}
    arrays = eqx.filter(state, eqx.is_array)
    return write_arrays(path, arrays, {"settings": settings, **counts})


def read_state(
    path: str | os.PathLike[str], begun: TrainingState, settings: dict[str, Any]
) -> TrainingState:
    """The state of a file in place of one that has just `begun`, for the same settings.

    **Errors**: CheckpointError, one line, for what is no such file and for other settings.
    """
    description = read_description(path)
    other = difference(description.get("settings"), json.loads(json.dumps(settings)))
    if other:
        raise CheckpointError(f"{path}: belongs to a training {other}; give its own, or begin anew")
    arrays, rest = eqx.partition(begun, eqx.is_array)
    state = eqx.combine(read_arrays(path, arrays), rest)
    counts = {name: description.get(name) for name in _COUNTS}
    whole = all(type(count) is int and count >= 0 for count in counts.values())
    if not whole or description["step"] > len(begun.losses):
        raise CheckpointError(f"{path}: is no state of a training; give one that it wrote")
    return replace(state, **counts)


def _lowest(state: TrainingState) -> float:
    return float(np.nanmin(state.scores)) if np.isfinite(state.scores).any() else math.nan


def _judged(
    task: Task, fixed: Any, state: TrainingState, losses: np.ndarray, options: TrainingOptions
) -> TrainingState:
    """State with its score, and as the best where it is; without validation, the last one is."""
    values = [_score(task.loss, fixed, state.averaged, one) for one in task.validation]
    score = float(np.mean(values)) if values else math.nan
    scores, best = state.scores.copy(), state.best
    if not values or (math.isfinite(score) and not score >= _lowest(state)):
        best = state.averaged
    scores[-(-state.step // options.check_every) - 1] = score
    return replace(state, best=best, losses=losses.copy(), scores=scores)


@eqx.filter_jit
def _step(loss, longest_slope: float, fixed, carried, examples, settings):
    weights, optimiser, averaged = carried
    rate, averaging = settings

    def of_weights(weights):
        return loss(eqx.combine(weights, fixed), examples)

    method = adam_method(longest_slope)
    stepped = adam_step(of_weights, weights, optimiser, rate, method)
    weights, optimiser, usable, (value, parts) = stepped
    averaged = jax.tree.map(
        lambda mean, new: new + averaging.astype(new.dtype) * (mean - new), averaged, weights
    )
    return (weights, optimiser, averaged), usable, value, parts


@eqx.filter_jit
def _score(loss, fixed, weights, examples):
    return loss(eqx.combine(weights, fixed), examples)[0]
