"""Choose τ from the captures: discrepancy principle and SURE."""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.noise import local_noise
from thincam_jax.reconstruction.problem import InverseProblem, forward, misfit, residuals, with_tau
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.splittings import admm_method

# Range of `find_tau` relative to the problem's own τ. A smaller τ never gains much, and with a
# slightly wrong PSF both rules choose one that spoils the image.
_SPAN = (0.8, 4.0)
# Ratios of residual to noise variance: uncertainty of the noise estimate, and the ratio reported.
_UNCERTAIN, _NOTICED = 0.3, 1.1


class ChosenTau(eqx.Module):
    """A problem with the chosen τ, its image, and (τ, criterion) of all trials.

    `reason` is a warning, or empty.
    """

    problem: InverseProblem
    image: Image
    tried: tuple[tuple[float, float], ...]
    reason: str = ""


def find_tau(rule: str, problem: InverseProblem, image: Float[Array, "..."]) -> ChosenTau:
    r"""Choose τ by "discrepancy" or "sure", robust to a wrong PSF and an estimated noise.

    Both rules assume that the residual is noise of known variance. With a slightly wrong PSF the
    residual is larger, and they choose a τ at which the image fits it nevertheless. So the search
    is limited to near the problem's own τ, and the residual may differ from the noise by as much as
    an estimate of noise does. If it remains above, the excess is counted as noise: τ becomes at
    least the problem's own times :math:`\sqrt{\sum w\,(Hf - g)^2/n}`.
    """
    own = _known_tau(problem)
    if rule == "discrepancy":
        found = discrepancy_tau(problem, image, span=_SPAN, tolerance=_UNCERTAIN)
    else:
        found = sure_tau(problem, image, jax.random.key(0), span=_SPAN)
    excess = float(jnp.sum(misfit(found.problem, found.image))) / _expected(problem)
    if not excess > _NOTICED:
        return found
    tau, least = float(found.problem.tau), own * math.sqrt(excess)
    reason = (
        f"the residual is {math.sqrt(excess):.3g} times the noise at tau = {tau:.3g}: the PSF is "
        "not quite right, or the noise is more than was estimated or given; counted as more noise, "
        f"tau is at least {least:.3g}"
    )
    raised = with_tau(problem, max(tau, least))
    return replace(found, problem=raised, reason=reason)


def discrepancy_tau(
    problem: InverseProblem,
    image: Image,
    *,
    iterations: int = 50,
    solves: int = 8,
    span: tuple[float, float] = (0.01, 100.0),
    tolerance: float = 0.0,
) -> ChosenTau:
    r"""The τ with which the residual is as large as the noise: Σ w (Hf − g)² = number of pixels.

    Morozov's discrepancy principle; the weights w must be 1/variance. The misfit grows with τ, so
    a bisection of log τ finds it, each solve starting from the previous image. It begins with the
    problem's own τ, and ends when the two agree within `tolerance`, or at a limit of the `span`,
    relative to that τ. It smooths slightly too much, because the image also fits some of the noise.

    **Arguments**: `image`, the first; `iterations` of each of `solves` reconstructions.
    """
    own, wanted = _known_tau(problem), _expected(problem)
    low, high = (math.log(own * factor) for factor in span)
    middle, tried, current = math.log(own), [], problem
    for _ in range(solves):
        current = with_tau(problem, math.exp(middle))
        image = _solve(current, image, iterations)
        ratio = float(jnp.sum(misfit(current, image))) / wanted
        tried.append((math.exp(middle), ratio))
        if abs(ratio - 1) <= tolerance:
            break
        low, high = (low, middle) if ratio > 1 else (middle, high)
        middle = (low + high) / 2
    return ChosenTau(current, image, tuple(tried))


def sure_tau(
    problem: InverseProblem,
    image: Image,
    key: PRNGKeyArray,
    *,
    iterations: int = 100,
    solves: int = 8,
    span: tuple[float, float] = (0.01, 100.0),
) -> ChosenTau:
    r"""The τ with the least predicted error of Hf, by Stein's unbiased risk estimate.

    .. math:: \mathrm{SURE} = \sum w\,(H\hat f - g)^2 - n + 2\,\mathrm{div}_g(H\hat f)

    with weights w = 1/variance and n pixels (Stein, Ann. Stat. 9, 1135, 1981). The divergence is a
    probe's response, :math:`b^T (H\hat f(g + \epsilon b) - H\hat f(g))/\epsilon` with b = ±1
    (Ramani, Blu and Unser, IEEE Trans. Image Process. 17, 1540, 2008), so each τ takes two
    reconstructions. The noise of light is larger where more falls, where the image also follows it
    more, so the probe has the local strength of the noise in the captures. It is the error on the
    sensor that is least, not that of the image: frequencies that the mask hardly passes count
    little. Minimised by golden sections of log τ.
    """
    own = _known_tau(problem)
    probes = _probes(problem, key)
    tried: list[tuple[float, float]] = []

    def criterion(log_tau: float) -> float:
        current = with_tau(problem, math.exp(log_tau))
        # All from the same image: otherwise each would converge further than the last.
        seen = _solve(current, image, iterations)
        moved = eqx.tree_at(
            lambda p: p.captures,
            current,
            tuple(c + b for c, b in zip(problem.captures, probes, strict=True)),
        )
        other = _solve(moved, image, iterations)
        value = float(_risk(current, seen, other, probes))
        tried.append((math.exp(log_tau), value))
        return value

    low, high = (math.log(own * factor) for factor in span)
    import scipy.optimize  # here, since it takes a tenth of a second

    found: Any = scipy.optimize.minimize_scalar(
        criterion, bounds=(low, high), method="bounded", options={"maxiter": solves}
    )
    best = with_tau(problem, math.exp(found.x))
    return ChosenTau(best, _solve(best, image, iterations), tuple(tried))


def _known_tau(problem: InverseProblem) -> float:
    tau = float(problem.tau)
    if not tau > 0:
        raise ValueError(f"tau = {tau:g}: a search by factors begins above 0; give tau > 0")
    return tau


def _expected(problem: InverseProblem) -> float:
    """The expected misfit of noise of variance 1/w."""
    return float(sum(jnp.sum(w > 0) for w in _full(problem))) / 2


def _full(problem: InverseProblem):
    pairs = zip(problem.weights, problem.captures, strict=True)
    return [jnp.broadcast_to(w, c.shape) for w, c in pairs]


class SearchInterrupted(KeyboardInterrupt):
    """Ctrl-C during a search, with the best image of the interrupted solve."""

    def __init__(self, image: Image):
        super().__init__()
        self.image = image


def _solve(problem: InverseProblem, image, iterations: int):
    method = admm_method(problem, relaxation=1.5)
    outcome = iterate(method, image, Schedule(iterations, 1e-5))
    if outcome.status == "interrupted":
        raise SearchInterrupted(outcome.image)
    return outcome.image


def _probes(problem: InverseProblem, key: PRNGKeyArray):
    """±1 in units of a tenth of the local noise, 0 in pixels of weight 0."""
    keys = jax.random.split(key, len(problem.captures))
    parts = zip(keys, _full(problem), problem.captures, strict=True)
    return tuple(
        0.1
        * jnp.where(w > 0, local_noise(c, w > 0) / jnp.sqrt(jnp.where(w > 0, w, 1)), 0)
        * jax.random.rademacher(k, w.shape, w.dtype)
        for k, w, c in parts
    )


@jax.jit
def _risk(problem: InverseProblem, image, moved, probes):
    """SURE in units of the noise's variance."""
    total = jnp.zeros((), image.dtype)
    for operator, weight, probe, residual in zip(
        problem.operators, _full(problem), probes, residuals(problem, image), strict=True
    ):
        response = forward(operator, moved - image)  # that of the background is less than a pixel's
        size = 0.01  # of the probe's square in units of the variance
        divergence = jnp.sum(weight * probe * response) / size
        known = jnp.sum((weight > 0).astype(weight.dtype))
        total = total + jnp.sum(weight * residual**2) - known + 2 * divergence
    return total
