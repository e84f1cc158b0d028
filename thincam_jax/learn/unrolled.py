r"""Unrolled ADMM: a few iterations whose penalties and thresholds are learned from examples.

ADMM converges whatever its penalties; how good the image is after five iterations depends on
them. Here every iteration has its own, found by gradient descent on pairs of captures and
images (Le-ADMM: Monakhova et al., Opt. Express 27, 28075, 2019). The physics stays what it
is: 5 numbers an iteration are learned, so that some tens of pairs suffice.
"""

import functools
import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax.design.stochastic import adam_method, adam_step
from thincam_jax.reconstruction.admm import AbstractSplitting, Penalties, State, admm_map
from thincam_jax.reconstruction.iterate import Status
from thincam_jax.reconstruction.problem import InverseProblem, uniform_image
from thincam_jax.reconstruction.splittings import splitting_of


class UnrolledAdmm(eqx.Module):
    r"""`iterations` of ADMM with parameters of their own, all positive as softplus of a number.

    In the units of the splitting, in which captures and operators are about 1, so that the image
    scales with the captures. Each batch element has its own units.

    - `data`, `variation`, `image`: penalties μ of the three splits, (iterations,).
    - `threshold`: by how much slopes are shortened, τ/μ₂.
    - `relaxation`: α.

    All are kept as the number before softplus.
    """

    data: Float[Array, " iteration"]
    variation: Float[Array, " iteration"]
    image: Float[Array, " iteration"]
    threshold: Float[Array, " iteration"]
    relaxation: Float[Array, " iteration"]

    def __init__(self, problem: InverseProblem, iterations: int = 5):
        """Untrained: plain ADMM with the default penalties of a problem, and its τ."""
        if iterations < 1:
            raise ValueError(f"iterations = {iterations}: give at least 1")
        splitting = splitting_of(problem)
        penalties = splitting.penalties

        def repeated(value):
            return jnp.full(iterations, value + jnp.log(-jnp.expm1(-value)))  # softplus⁻¹

        self.data = repeated(penalties.data)
        self.variation = repeated(penalties.variation)
        self.image = repeated(penalties.image)
        # A threshold of zero has no finite value before softplus.
        least = jnp.finfo(self.data.dtype).eps
        self.threshold = repeated(jnp.maximum(splitting.tau / penalties.variation, least))
        self.relaxation = repeated(jnp.ones_like(splitting.tau))

    def __call__(self, problem: InverseProblem) -> Float[Array, "*batch channel plane y x"]:
        """The image after all iterations, from the uniform one; the problem's τ is not used."""
        return self.images(problem)[-1]

    def images(self, problem: InverseProblem) -> Float[Array, "iteration *batch channel plane y x"]:
        """The image after each iteration."""
        captures, weights = _elements(problem)
        images = jax.vmap(_iterated, in_axes=(None, None, 0, 0))(self, problem, captures, weights)
        return jnp.moveaxis(images, 0, 1).reshape(self.data.shape[0], *problem.image_shape)

    def parameters(self) -> tuple[Array, Array, Array, Array, Array]:
        """The three penalties, threshold and relaxation, each (iterations,)."""
        rows = (self.data, self.variation, self.image, self.threshold, self.relaxation)
        data, variation, image, threshold, relaxation = (jax.nn.softplus(r) for r in rows)
        return data, variation, image, threshold, relaxation


def _iterated(model: UnrolledAdmm, problem: InverseProblem, captures, weights):
    """The images of one batch element."""
    problem = eqx.tree_at(lambda p: (p.captures, p.weights), problem, (captures, weights))
    splitting = splitting_of(problem)
    first = splitting.start(uniform_image(problem))
    # A loop, since the derivative of a straight program takes long to compile.
    iterate = functools.partial(_iterate, splitting)
    _, images = jax.lax.scan(iterate, first, model.parameters())
    return images


def _iterate(splitting: AbstractSplitting, state: State, parameters):
    """One iteration with its own parameters, and its image."""
    data, variation, image, threshold, relaxation = parameters
    # The variation's proximal map shortens slopes by τ/μ₂.
    splitting = eqx.tree_at(lambda s: s.tau, splitting, threshold * variation)
    splitting = splitting.with_penalties(Penalties(data, variation, image))
    mapped = admm_map(state, splitting)
    state = jax.tree.map(lambda q, t: q + relaxation * (t - q), state, mapped)
    return state, splitting.image(state)


def _elements(problem: InverseProblem):
    """Captures and weights with one batch axis, (element, channel, y, x)."""
    captures = tuple(c.reshape(-1, *c.shape[-3:]) for c in problem.captures)
    pairs = zip(problem.weights, problem.captures, strict=True)
    weights = tuple(jnp.broadcast_to(w, c.shape).reshape(-1, *c.shape[-3:]) for w, c in pairs)
    return captures, weights


class UnrolledTraining(eqx.Module):
    """The best model by its loss, and the loss before each step.

    - `status`: "converged" never: "iterations_exhausted", or "non_finite" if a loss was NaN,
      after which training stops.
    """

    model: UnrolledAdmm
    losses: tuple[float, ...]
    status: Status


@dataclass(frozen=True)
class Adam:
    """Descent by Adam (optax).

    - `steps`, `batch`: gradient steps, and pairs drawn for each, without replacement.
    - `learning_rate`: in the numbers before softplus.
    """

    steps: int = 100
    batch: int = 4
    learning_rate: float = 0.05


def train(
    model: UnrolledAdmm,
    problem: InverseProblem,
    images: Float[Array, "pair channel plane y x"],
    *,
    key: PRNGKeyArray,
    descent: Adam = Adam(),
) -> UnrolledTraining:
    """Fit a model to pairs of captures and images, by the mean squared error.

    `problem`: its captures (pair, channel, y, x) belong to `images`.

    The error of a pair is relative to its image's mean square, so that dark scenes count as
    much as bright ones. Of all models that of the lowest loss on all pairs is returned, taken every
    tenth step.
    """
    batch, steps, rate = descent.batch, descent.steps, descent.learning_rate
    _check_pairs(problem, images, batch)
    rate = checks.positive("learning_rate", rate, "a number").astype(images.dtype)
    state = adam_method().init(model)  # type: ignore[arg-type]
    best, lowest, losses = model, float(training_loss(model, problem, images)), []
    for n in range(steps):
        chosen = jax.random.choice(jax.random.fold_in(key, n), len(images), (batch,), replace=False)
        model, state, loss = _descend(model, state, rate, problem, images, chosen)
        losses.append(float(loss))
        if not math.isfinite(losses[-1]):
            return UnrolledTraining(best, tuple(losses), "non_finite")
        if n % 10 == 9 or n == steps - 1:
            whole = float(training_loss(model, problem, images))
            if whole < lowest:
                best, lowest = model, whole
    return UnrolledTraining(best, tuple(losses), "iterations_exhausted")


@jax.jit
def training_loss(
    model: UnrolledAdmm, problem: InverseProblem, images: Float[Array, "pair channel plane y x"]
) -> Float[Array, ""]:
    """Mean over the pairs of ‖image found − image‖²/‖image‖²."""
    axes = (-4, -3, -2, -1)
    errors = jnp.sum((model(problem) - images) ** 2, axis=axes)
    sizes = jnp.sum(images**2, axis=axes)
    return jnp.mean(errors / jnp.where(sizes > 0, sizes, 1))


@jax.jit
def _descend(model: UnrolledAdmm, state, rate, problem: InverseProblem, images, chosen):
    """A step of Adam on some of the pairs."""
    captures, weights = _elements(problem)
    some = jax.tree.map(lambda x: x[chosen], (captures, weights))
    problem = eqx.tree_at(lambda p: (p.captures, p.weights), problem, some)

    def loss(model):
        return training_loss(model, problem, images[chosen]), None

    model, state, _, (value, _) = adam_step(loss, model, state, rate, adam_method())
    return model, state, value


def _check_pairs(problem: InverseProblem, images: Array, batch: int) -> None:
    if len(problem.image_shape) != 5 or images.shape != problem.image_shape:
        raise ValueError(
            f"images have shape {images.shape} for captures {problem.captures[0].shape}; give "
            f"captures (pair, channel, y, x) and images {problem.image_shape}"
        )
    if not 1 <= batch <= len(images):
        raise ValueError(f"batch = {batch} of {len(images)} pairs; give 1 to {len(images)}")
