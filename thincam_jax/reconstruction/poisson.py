r"""Reconstruction from few photons: the Poisson likelihood of counts, by L-BFGS.

Counts y of a mean m = Hf + b, with a known background b (dark counts, stray light), have

.. math:: -\log L = \sum_k w_k \Big(m_k - y_k + y_k \log\frac{y_k}{m_k}\Big) + \mathrm{const},

half of the deviance. With total variation and f ≥ 0 that is minimised,

.. math:: E(f) = -\log L + \tau\, TV_\epsilon(f),\qquad f = s\,\varphi(\theta) > 0,

over θ, with φ one of the links of `LINKS` and s the brightness of the even image. TV is smoothed
by its Moreau envelope (a Huber function of the length of each vector of differences), so
that E has a gradient. At high counts least squares with weights 1/y say the same; at a few
counts a pixel they do not.
"""

import time
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction.drive import Outcome
from thincam_jax.reconstruction.outcome import concluded_by
from thincam_jax.reconstruction.problem import Deconvolution, uniform_level
from thincam_jax.reconstruction.scaled import start_image
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.reconstruction.tv_prox import VariationRegulariser

Link = Literal["softplus", "exponential", "square"]
LINKS: tuple[Link, ...] = ("softplus", "exponential", "square")


class Counts(eqx.Module):
    """Counts with what is known of them, for module-level losses.

    - `problem`: its captures are counts, its weights 1, or 0 where a pixel is dead or saturated.
    - `background`: b of each capture, counts.
    - `unit`: s, (*batch, 1, 1, 1, 1), brightness at which θ is about 1.
    - `smoothing`: ε in parts of s: differences below it are smoothed, not kept as edges.
    - `floor`: a mean count below which no pixel is thought to be, so that log m exists.
    """

    problem: Deconvolution
    background: tuple[Float[Array, "..."], ...]
    unit: Float[Array, "*batch 1 1 1 1"]
    smoothing: Float[Array, ""]
    floor: Float[Array, ""]
    link: Link = eqx.field(static=True)

    def __init__(
        self,
        problem: Deconvolution,
        *,
        background=None,
        smoothing=0.01,
        link: Link = "softplus",
    ):
        checks.choice("link", link, LINKS)
        dtype = problem.captures[0].dtype
        _check_counts(problem)
        given = [0.0] * len(problem.captures) if background is None else background
        if len(given) != len(problem.captures):
            raise ValueError(
                f"{len(given)} backgrounds for {len(problem.captures)} captures; give one for each"
            )
        self.problem, self.link = problem, link
        self.background = tuple(jnp.asarray(b, dtype) for b in given)
        self.smoothing = checks.positive("smoothing", smoothing, "parts of the mean").astype(dtype)
        self.unit, self.floor = _unit(problem, self.background)

    def image(self, theta: Float[Array, "*batch channel plane y x"]):
        """f of θ."""
        return self.unit * positive(self.link, theta.astype(self.unit.dtype))

    def theta(self, image: Float[Array, "*batch channel plane y x"]):
        """θ of an image; what is below a thousandth of s is raised to that.

        In the default precision, in which solvers keep their memory whatever that of θ.
        """
        theta = unlinked(self.link, jnp.maximum(image / self.unit, 1e-3))
        return theta.astype(jnp.result_type(float))


def solve_poisson(
    problem: Deconvolution,
    *,
    background=None,
    image: Float[Array, "..."] | None = None,
    link: Link = "softplus",
    smoothing=0.01,
    iterations: int = 300,
    tolerance: float = 1e-4,
    memory: int = 10,
) -> Outcome:
    """The most probable image of counts, by L-BFGS (optimistix), always non-negative.

    One piece of compiled code: there is no progress to be watched.

    **Arguments**

    - `problem`: its captures are counts (photo-electrons, not digital numbers), background
      included; its weights are 1 or 0; its τ is in counts of log-likelihood per unit of TV.
    - `background`: b, for each capture an array that broadcasts to it; default none.
    - `image`: to start from; default the even image.
    - `link`: φ: "softplus", log(1 + e^θ); "exponential"; "square", θ².
    - `smoothing`: ε of TV, in parts of the mean brightness.
    - `tolerance`: relative change of the objective and of θ at which to end.
    - `memory`: how many steps L-BFGS remembers.

    **Errors**: ValueError, one line, for negative counts and backgrounds that do not fit.
    """
    began = time.perf_counter()
    counts = Counts(problem, background=background, smoothing=smoothing, link=link)
    start = even_start(counts) if image is None else start_image(problem, image)
    limit = jnp.asarray(tolerance, float)
    solution = optimistix.minimise(
        poisson_loss,
        optimistix.LBFGS(rtol=limit, atol=limit, history_length=memory),  # type: ignore[arg-type]
        counts.theta(start),
        args=counts,
        max_steps=iterations,
        throw=False,
    )
    return concluded_by(
        solution,
        start,
        counts.image(solution.value),
        eqx.Partial(poisson_objective, counts),
        began=began,
    )


def poisson_loss(theta: Float[Array, "..."], counts: Counts) -> Float[Array, ""]:
    """E of f(θ), summed over the batch."""
    return jnp.sum(poisson_objective(counts, counts.image(theta))).astype(theta.dtype)


@jax.jit
def poisson_objective(
    counts: Counts, image: Float[Array, "*batch channel plane y x"]
) -> Float[Array, "*batch"]:
    """−log L + τ TV_ε of each member of the batch."""
    parts = [
        jnp.sum(w * half_deviance(y, m), axis=(-3, -2, -1))
        for w, y, m in zip(
            counts.problem.weights, counts.problem.captures, mean_counts(counts, image), strict=True
        )
    ]
    scale = counts.unit[..., 0, 0, 0, 0]
    rough = smooth_variation(counts.problem.variation, image / counts.unit, counts.smoothing)
    return sum(parts) + counts.problem.tau * scale * rough


def mean_counts(counts: Counts, image: Float[Array, "*batch channel plane y x"]):
    """m = Hf + b of each capture."""
    return tuple(
        # Rounding in the transforms can bring a dark pixel below zero.
        jnp.maximum(operator(image), 0) + b + counts.floor
        for operator, b in zip(counts.problem.operators, counts.background, strict=True)
    )


def half_deviance(counts: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """m − y + y log(y/m), m where y = 0; without cancellation where m is near y."""
    seen = counts > 0
    safe = jnp.where(seen, counts, 1)
    excess = jnp.where(seen, (mean - counts) / safe, 0)
    return jnp.where(seen, safe * (excess - jnp.log1p(excess)), mean)


def smooth_variation(
    variation: TotalVariation, image: Float[Array, "*batch channel plane y x"], smoothing
) -> Float[Array, "*batch"]:
    r"""The Moreau envelope of TV's norm: min over u of φ(u) + ‖u − Ψf‖²/(2ε).

    It is below TV by at most ε/2 at each place, and equal to ‖Ψf‖²/(2ε) where differences are
    shorter than ε. With u the minimiser φ(u) = ⟨u, Ψf − u⟩/ε, since φ is a norm.
    """
    slopes = VariationRegulariser(variation).analyse(image)
    kept = variation.prox(slopes, smoothing)
    pairs = list(zip(slopes, kept, strict=True))
    total = sum(u * (s - u) + (s - u) ** 2 / 2 for s, u in pairs)
    return jnp.sum(total, axis=(-4, -3, -2, -1)) / smoothing


def positive(link: Link, theta: Float[Array, "..."]) -> Float[Array, "..."]:
    """φ(θ)."""
    if link == "softplus":
        return jax.nn.softplus(theta)
    return jnp.exp(theta) if link == "exponential" else theta**2


def unlinked(link: Link, value: Float[Array, "..."]) -> Float[Array, "..."]:
    """θ with φ(θ) = value > 0."""
    if link == "softplus":
        return value + jnp.log(-jnp.expm1(-value))
    return jnp.log(value) if link == "exponential" else jnp.sqrt(value)


def even_start(counts: Counts) -> Float[Array, "*batch channel plane y x"]:
    """The even image of brightness s."""
    return jnp.broadcast_to(counts.unit, counts.problem.image_shape)


@jax.jit
def _unit(problem: Deconvolution, background):
    captures = tuple(c - b for c, b in zip(problem.captures, background, strict=True))
    level = uniform_level(eqx.tree_at(lambda p: p.captures, problem, captures))
    level = jnp.mean(jnp.maximum(level, 0), axis=-1)
    # Without a single count, the brightness that would have given one in each capture.
    even = jnp.ones(problem.image_shape[-4:], level.dtype)
    light = sum(jnp.sum(operator(even)) for operator in problem.operators)
    least = jnp.where(light > 0, 1 / jnp.where(light > 0, light, 1), 1)
    mean = jnp.mean(jnp.stack([jnp.mean(c) for c in problem.captures]))
    unit = jnp.maximum(level, least)[..., None, None, None, None]
    return unit, jnp.maximum(1e-6 * mean, 1e-6)


def _check_counts(problem: Deconvolution) -> None:
    for capture in problem.captures:
        # Simulated means may be below zero by rounding; that counts as none.
        rounding = 1e-6 * jnp.max(jnp.abs(capture))
        if not checks.is_traced(capture) and bool((capture < -rounding).any()):
            raise ValueError(
                f"a capture has negative counts, the least {float(capture.min()):.3g}; give raw "
                "counts, and the dark level as background"
            )
