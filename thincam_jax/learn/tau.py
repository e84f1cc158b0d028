"""The weight of a regularisation, learned from known images."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.design.stochastic import adam_method, adam_step
from thincam_jax.reconstruction.implicit_gradient import solve_fixed_point
from thincam_jax.reconstruction.problem import InverseProblem, with_tau


def learn_tau(
    problems: Sequence[InverseProblem],
    images: Sequence[Float[Array, "*batch channel plane y x"]],
    *,
    steps: int = 30,
    rate: float = 0.2,
    iterations: int = 300,
) -> tuple[Float[Array, ""], tuple[float, ...]]:
    r"""One factor on all problems' τ under which known images come back best.

    .. math:: \min_c \frac1n \sum_p \operatorname{mean} \big[\hat f_p(c\,\tau_p) - f_p\big]^2

    Two levels: each f̂ minimises its problem, and its slope in ln c follows by implicit
    differentiation (`solve_fixed_point`). Returns c and the mean before each step of Adam.

    - `problems`: with their τ. `images`: the true one of each.
    - `steps`, `rate`: number and size of the steps of Adam on ln c. `iterations`: number of
      iterations of ADMM for each image.

    **Errors**: ValueError for other numbers of images than problems, and out of range.
    """
    if not problems or len(problems) != len(images):
        raise ValueError(f"{len(problems)} problems, {len(images)} images; give one for each")
    checks.at_least_one({"steps": steps, "iterations": iterations})
    logarithm = jnp.zeros((), images[0].dtype)
    state, course = adam_method().init(logarithm), []
    step_size = checks.positive("rate", rate, "a ratio")
    for _ in range(steps):
        logarithm, state, error = _stepped(
            logarithm, state, step_size, tuple(problems), tuple(images), iterations
        )
        course.append(float(error))
    return jnp.exp(logarithm), tuple(course)


@eqx.filter_jit
def _stepped(logarithm, state, rate, problems, images, iterations: int):
    def loss(logarithm):
        errors = [
            jnp.mean((_solved(problem, logarithm, truth.dtype, iterations) - truth) ** 2)
            for problem, truth in zip(problems, images, strict=True)
        ]
        return sum(errors[1:], errors[0]) / len(errors), None

    logarithm, state, _, (error, _) = adam_step(loss, logarithm, state, rate, adam_method())
    return logarithm, state, error


def _solved(problem: InverseProblem, logarithm, dtype, iterations: int):
    scaled = with_tau(problem, problem.tau * jnp.exp(logarithm))
    first = jnp.zeros(problem.image_shape, dtype)
    return solve_fixed_point(scaled, first, iterations=iterations, relaxation=1.5).image
