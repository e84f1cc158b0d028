r"""Training of a `Suggester` on designs that are sampled and scored here.

Two parts, both with Adam (optax):

1. *Warm-up.* Regression from the levels of sampled designs to their points, of the guess that is
   nearest to the point only: designs with like responses then belong to different guesses, and
   none is drawn to the mean of two designs, which is neither.
2. *Tandem.* The misfit between target levels and those of the suggested design, differentiated
   through the response model: any design that gives the response is right. Again of the best guess,
   and of a random one now and then, so that all of them learn. Half of the targets are responses of
   sampled designs; the others are such ones shifted and bent by some dB, which no design fulfils
   and of which the nearest is to be found.
"""

import functools
from dataclasses import dataclass
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import check_fields, quantity, whole
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.match import ResponseModel
from thincam_jax.design.search import even_samples
from thincam_jax.design.stochastic import adam
from thincam_jax.learn.suggestions import Suggester

# Designs whose levels are computed at a time.
_AT_A_TIME = 32
# Levels that vary less than this over all designs are not blown up, dB.
_LEAST_SCALE = 0.5
# What the guesses that are not the nearest count in the warm-up, so that none is left behind.
_OTHERS = 0.02
# Its batch over that of the tandem, whose steps cost far more.
_WARM_UP_BATCH = 4
# How often a random guess is taken in place of the best.
_RANDOM = 0.1
# Bends of targets: amplitude of each, dB, of constant, slope and this many cosines.
_BEND, _COSINES = 2.0, 4


class TrainedSuggester(Module):
    """Result of a training.

    - `suggester`: the network after the last step.
    - `warm_up`: distance of the nearest guess in the cube, root mean square, at every step.
    - `history`: mean misfit of what was suggested, dB, at every tandem step.
    - `skipped`: steps and samples that met a number that is none; they changed nothing.
    """

    suggester: Suggester
    warm_up: Float[Array, " step"]
    history: Float[Array, " tandem_step"]
    skipped: int


@checked
@dataclass(frozen=True)
class SuggesterTraining:
    """Size of a network that suggests designs, and its training.

    - `samples`: designs, sampled evenly, whose levels are the examples.
    - `guesses`, `width`, `depth`: points that the network gives, and its hidden layers.
    - `warm_up`, `steps`: numbers of steps of the two parts; a tandem step costs some 8·`batch`
      responses.
    - `rate`: step size of Adam, falling to zero as a cosine in each part; the tandem begins at a
      tenth.

    **Errors**: ValueError for numbers below 1, and for a rate that is not positive.
    """

    samples: Annotated[int, whole(1)] = 16384
    guesses: Annotated[int, whole(1)] = 4
    width: Annotated[int, whole(1)] = 128
    depth: Annotated[int, whole(1)] = 3
    warm_up: Annotated[int, whole(1)] = 6000
    steps: Annotated[int, whole(1)] = 400
    batch: Annotated[int, whole(1)] = 64
    rate: Annotated[float, quantity(positive=True)] = 4e-3

    def __post_init__(self):
        check_fields(self)


@checked
def train_suggester(
    model: ResponseModel, settings: SuggesterTraining = SuggesterTraining(), *, key: Key
) -> TrainedSuggester:
    """A network that answers `suggest` for one camera and the space of a `ResponseModel`.

    **Errors**: ValueError where no sampled design has a finite response.
    """
    key = random_key(key)
    dtype = model.space.lower.dtype
    of_samples, of_network, of_steps = jax.random.split(key, 3)
    points, levels = _examples(model, settings.samples, of_samples)
    size = {"guesses": settings.guesses, "width": settings.width, "depth": settings.depth}
    fresh = Suggester(model, key=of_network, **size)
    scale = jnp.maximum(jnp.std(levels, axis=0), _LEAST_SCALE)
    fresh = eqx.tree_at(lambda s: (s.mean, s.scale), fresh, (jnp.mean(levels, axis=0), scale))
    rate = jnp.asarray(settings.rate, dtype)
    layers, distances, misfits, skipped = _train(fresh, points, levels, of_steps, rate, settings)
    suggester = eqx.tree_at(lambda s: s.layers, fresh, layers)
    failed = settings.samples - len(points)
    return TrainedSuggester(suggester, distances, misfits, int(skipped) + failed)


def _examples(model: ResponseModel, samples: int, key):
    """Points of the cube with finite levels, and these."""
    points = even_samples(model.space.size, samples, key, model.space.lower.dtype)
    levels = _levels(model, points)
    usable = np.isfinite(np.asarray(levels)).all(axis=-1)
    if not usable.any():
        raise ValueError(
            f"none of {samples} designs has a finite response; change the space or the setup"
        )
    return points[usable], levels[usable]


@jax.jit
def _levels(
    model: ResponseModel, points: Float[Array, "point variable"]
) -> Float[Array, "point ring"]:
    return jax.lax.map(model.levels, points, batch_size=_AT_A_TIME)


@functools.partial(jax.jit, static_argnames="settings")
def _train(suggester: Suggester, points, levels, key, rate, settings: SuggesterTraining):
    batch = settings.batch

    def with_layers(layers) -> Suggester:
        return eqx.tree_at(lambda s: s.layers, suggester, layers)

    def towards_designs(layers, step_key):
        chosen = jax.random.randint(step_key, (_WARM_UP_BATCH * batch,), 0, len(points))
        guesses = jax.vmap(with_layers(layers))(levels[chosen])
        squared = jnp.mean((guesses - points[chosen][:, None]) ** 2, axis=-1)
        nearest = jnp.mean(jnp.min(squared, axis=-1))
        return nearest + _OTHERS * jnp.mean(squared), jnp.sqrt(nearest)

    def towards_levels(layers, step_key):
        of_targets, of_guesses = jax.random.split(step_key)
        target = _targets(levels, of_targets, batch)
        guesses = jax.vmap(with_layers(layers))(target)
        misfit = jnp.mean(_chosen_misfits(suggester.model, guesses, target, of_guesses))
        return misfit, misfit

    first, second = jax.random.split(key)
    start = suggester.layers
    lengths = settings.warm_up, settings.steps
    layers, distances, in_vain = adam(towards_designs, start, first, rate, lengths[0], most=1.0)
    layers, misfits, skipped = adam(towards_levels, layers, second, rate / 10, lengths[1], most=1.0)
    return layers, distances, misfits, in_vain + skipped


def _chosen_misfits(model: ResponseModel, guesses, target, key) -> Float[Array, " target"]:
    """Misfit of each target's best guess, or now and then of any; only this is differentiated."""
    judged = jax.vmap(jax.vmap(model.misfit, in_axes=(0, None)))(
        jax.lax.stop_gradient(guesses), target
    )
    best = jnp.argmin(jnp.where(jnp.isfinite(judged), judged, jnp.inf), axis=-1)
    of_any, of_which = jax.random.split(key)
    anyone = jax.random.randint(of_which, best.shape, 0, guesses.shape[1])
    taken = jnp.where(jax.random.uniform(of_any, best.shape) < _RANDOM, anyone, best)
    points = jnp.take_along_axis(guesses, taken[:, None, None], axis=1)[:, 0]
    return jax.vmap(model.misfit)(points, target)


def _targets(levels: Float[Array, "point ring"], key, batch: int) -> Float[Array, "target ring"]:
    """Responses of sampled designs, every second one shifted and bent."""
    of_choice, of_bends = jax.random.split(key)
    target = levels[jax.random.randint(of_choice, (batch,), 0, len(levels))]
    place = (np.arange(levels.shape[1]) + 0.5) / levels.shape[1]
    shapes = [np.ones_like(place), 2 * place - 1]
    shapes += [np.cos(np.pi * k * place) for k in range(2, 2 + _COSINES)]
    weights = jax.random.normal(of_bends, (batch, len(shapes)), levels.dtype)
    bends = _BEND * weights @ jnp.asarray(np.stack(shapes), levels.dtype)
    every_second = jnp.arange(batch)[:, None] % 2 == 0
    return jnp.maximum(target + jnp.where(every_second, bends, 0.0), 0.0)
