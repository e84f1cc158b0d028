"""The iterative methods behind `reconstruct`: from a problem to a `Reconstruction`."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax import _checks
from thincam_jax.operators.crop_convolution import cut, place
from thincam_jax.reconstruct.drive import Callback, Outcome, drive
from thincam_jax.reconstruct.problem import Deconvolution, uniform_level
from thincam_jax.reconstruct.tv_method import AdmmTotalVariation


class Options(NamedTuple):
    """How to iterate; see `reconstruct`."""

    iterations: int
    tolerance: float
    relaxation: float
    start: Float[Array, "*batch y x"] | None
    callback: Callback | None


def minimise(problem: Deconvolution, options: Options, *, even_start: bool) -> Outcome:
    """ADMM-TV from the image given, an even one, or zero.

    An even image explains the bright background of a zone aperture's capture at once, which would
    else take hundreds of iterations; a field that is mostly dark is nearer to zero.
    """
    _check(options)
    image = _first(problem, options.start, even_start)
    method = AdmmTotalVariation(problem, relaxation=options.relaxation)
    return drive(
        method,
        image,
        iterations=options.iterations,
        tolerance=options.tolerance,
        adapt_until=options.iterations // 2,
        callback=options.callback,
    )


def _first(problem: Deconvolution, start, even: bool) -> Float[Array, "*batch channel plane y x"]:
    shape, dtype = problem.image_shape, problem.captures[0].dtype
    if start is None:
        level = uniform_level(problem)[..., None, None, None] if even else jnp.zeros((), dtype)
        return jnp.broadcast_to(level, shape)
    start = jnp.asarray(start, dtype)
    size = 1
    for n in shape[:-2]:
        size *= n
    if start.size != size * start.shape[-1] * start.shape[-2]:
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


def _check(options: Options) -> None:
    if options.iterations < 1:
        raise ValueError(f"iterations = {options.iterations}; give at least 1")
    _checks.non_negative("tolerance", options.tolerance, "parts of one")
    if not 0 < options.relaxation < 2:
        raise ValueError(f"relaxation = {options.relaxation:g} is out of range; give 0 < α < 2")
