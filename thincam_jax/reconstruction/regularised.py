"""The iterative methods behind `reconstruct`: from a problem to a `Reconstruction`."""

import math
import time
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.reconstruction._jaxopt import AndersonAdmm
from thincam_jax.reconstruction.apart import Apart, worth_taking_apart
from thincam_jax.reconstruction.choose_tau import SearchInterrupted, discrepancy_tau, sure_tau
from thincam_jax.reconstruction.drive import LOOK_EVERY, AbstractMethod, Callback, Outcome, drive
from thincam_jax.reconstruction.high_pass import Judged, high_passed, levelled
from thincam_jax.reconstruction.problem import Deconvolution, uniform_level
from thincam_jax.reconstruction.proximal import solve_proximal
from thincam_jax.reconstruction.regulariser import AbstractRegulariser
from thincam_jax.reconstruction.tv_method import AdmmTotalVariation
from thincam_jax.reconstruction.two_step import solve_two_step

TauRule = Literal["discrepancy", "sure"]
Iterative = Literal["admm_tv", "fista", "twist"]
Acceleration = Literal["none", "anderson"]

# Penalties that go on changing make the objective jump: on the captures of tests/reconstruction/
# test_acceleration.py ADMM then needs 1.4 to twice the iterations.
_BALANCED = 30
# Of the iterations for a biased camera, those without its even light.
_FIRST_PART = 0.4


class Options(NamedTuple):
    """How to iterate; see `reconstruct`. `rule` finds τ, None takes the problem's.

    `regulariser`: of proximal gradients; None takes the problem's total variation. `acceleration`:
    of ADMM.
    """

    method: Iterative
    iterations: int
    tolerance: float
    relaxation: float
    start: Float[Array, "*batch y x"] | None
    callback: Callback | None
    rule: TauRule | None = None
    regulariser: AbstractRegulariser | None = None
    acceleration: Acceleration = "none"


class Solved(NamedTuple):
    """An outcome, and what a search multiplied the problem's τ by."""

    outcome: Outcome
    tau_factor: float = 1.0


def minimise(problem: Deconvolution, options: Options, *, even_start: bool) -> Solved:
    """The minimiser, from the image given, an even one, or zero.

    An even image explains the bright background of a zone aperture's capture at once, which would
    else take hundreds of iterations; a field that is mostly dark is nearer to zero.
    """
    image = first_image(problem, options.start, even=even_start)
    if problem.nonnegative:  # the best image so far may be this one
        image = jnp.maximum(image, 0)
    if options.rule is None:
        if even_start and options.start is None and options.method == "admm_tv":
            return Solved(_by_admm_in_two(problem, image, options))
        return Solved(_iterate(problem, image, options))
    began = time.perf_counter()
    try:
        if options.rule == "discrepancy":
            found = discrepancy_tau(problem, image)
        else:
            found = sure_tau(problem, image, jax.random.key(0))
    except SearchInterrupted as end:
        seconds = time.perf_counter() - began
        return Solved(Outcome(end.image, "interrupted", (), 0, seconds))
    outcome = _iterate(found.problem, found.image, options)
    outcome = outcome._replace(seconds=time.perf_counter() - began)
    return Solved(outcome, float(found.problem.tau / problem.tau))


def _iterate(problem: Deconvolution, image, options: Options) -> Outcome:
    """The method asked for."""
    if options.method == "admm_tv":
        return _by_admm(problem, image, options)
    solve = solve_proximal if options.method == "fista" else solve_two_step
    return solve(
        problem,
        regulariser=options.regulariser,
        image=image,
        iterations=options.iterations,
        tolerance=options.tolerance,
        callback=options.callback,
    )


def _by_admm(problem: Deconvolution, image, options: Options, done: int = 0) -> Outcome:
    return drive(
        admm_method(problem, options.relaxation, options.acceleration),
        image,
        iterations=options.iterations,
        tolerance=options.tolerance,
        adapt_until=done + min(_BALANCED, (options.iterations - done) // 2),
        callback=options.callback,
        done=done,
    )


def _by_admm_in_two(problem: Deconvolution, image, options: Options) -> Outcome:
    """First without the even light, then with all of the data from the image so found."""
    first = _without_even_light(problem, image, options)
    if first is None:
        return _by_admm(problem, image, options)
    if first.status in ("stopped", "interrupted", "non_finite"):
        return first
    try:
        second = _by_admm(problem, first.image, options, first.iterations)
    except KeyboardInterrupt:  # before its iterations, which keep their own best image
        return first._replace(status="interrupted")
    return second._replace(
        history=first.history + second.history[1:], seconds=first.seconds + second.seconds
    )


def _without_even_light(problem: Deconvolution, image, options: Options) -> Outcome | None:
    """The first part of the iterations, levelled; None if the camera or their number asks for none.

    Whole chunks between two looks, so that a callback sees every tenth iteration throughout.
    """
    count = LOOK_EVERY * round(_FIRST_PART * options.iterations / LOOK_EVERY)
    easier = high_passed(problem) if count else None
    if easier is None:
        return None
    outcome = drive(
        Judged(admm_method(easier, options.relaxation, options.acceleration), problem),
        image,
        iterations=count,
        tolerance=options.tolerance,
        adapt_until=min(_BALANCED, count // 2),
        callback=options.callback,
    )
    return outcome._replace(image=levelled(problem, outcome.image))


def admm_method(
    problem: Deconvolution, relaxation: float, acceleration: Acceleration = "none"
) -> AbstractMethod:
    """ADMM for a problem, or for each of its parts."""
    kind = AndersonAdmm if acceleration == "anderson" else AdmmTotalVariation

    def method(part: Deconvolution) -> AbstractMethod:
        return kind(part, relaxation=relaxation)

    return Apart(problem, method) if worth_taking_apart(problem) else method(problem)


def first_image(
    problem: Deconvolution, start, *, even: bool
) -> Float[Array, "*batch channel plane y x"]:
    """The start given, amid zeros where it is smaller than the field; else an even one, or zero."""
    shape, dtype = problem.image_shape, problem.captures[0].dtype
    if start is None:
        level = even_level(problem)[..., None, None, None] if even else jnp.zeros((), dtype)
        return jnp.broadcast_to(level, shape)
    start = jnp.asarray(start, dtype)
    if start.ndim < 2 or start.size != math.prod((*shape[:-2], *start.shape[-2:])):
        raise ValueError(
            f"start has shape {start.shape}; give an image of the result's batch and planes, "
            f"{shape[:-2]}, and its rows and columns"
        )
    rows, columns = start.shape[-2:]
    start = start.reshape(*shape[:-2], rows, columns)
    if (rows, columns) == problem.field_shape:
        return start
    corner = [(f - n) // 2 for f, n in zip(problem.field_shape, (rows, columns), strict=True)]
    if min(corner) < 0:
        raise ValueError(
            f"start has {rows}×{columns} pixels, more than the field's {problem.field_shape}"
        )
    return place(start, corner, problem.field_shape)


def middle(image: Float[Array, "*batch y x"], shape) -> Float[Array, "*batch v u"]:
    """The middle of an image."""
    corner = [(n - s) // 2 for n, s in zip(image.shape[-2:], shape, strict=True)]
    return cut(image, corner, shape)


even_level = jax.jit(uniform_level)
