"""Noise of captures, found from what a data step leaves of them.

The residual's power in parts of the captures, over that of white noise on which the same data step
is tried, is the variance there. That of light grows with it: a + b·light, by which each pixel is
weighted, since a mean over the sensor tells too little in bright parts and too much in dark ones.
Captures that an image explains whatever their noise, as those of a mask that focuses, leave no
residual: there a + b·light is that of their finest detail (the photon-transfer curve).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from thincam_jax.imaging.operators import AbstractOperator
from thincam_jax.reconstruction.noise import details_by_light
from thincam_jax.reconstruction.normal_equations import INNER_STEPS, AbstractNormal, IterativeNormal
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    convolutions,
    detector_shape,
    forward,
    or_one,
    residuals,
)
from thincam_jax.reconstruction.regularisers import Image

_LARGEST_MISTAKE = 4.0  # of the noise's deviation, that is corrected
_LEAST_SHARE = 0.02  # of the noise, that the data step leaves, by which it can be found
_PARTS, _SMALLEST = 3, 8  # along each side of a capture, and the pixels that such a part has
# Pixels are weighted where the variance differs from part to part by such a factor, as that of
# uniform noise seems to by 1.2, or what is left of an object at 40 dB by 2; and where a + b·light
# explains it to such a part: the last does so to 0.2 to 2.
_CONTRAST, _UNEXPLAINED = 1.4, 0.15
_LEAST_VARIANCE = 0.1  # of a pixel, over that of one of mean light
# The same of classes of the captures' light, each of a median. Behind lenses variances differ by 4
# to 200, explained to 0.02 to 0.1, fine texture to 0.4; of even noise by up to 1.4. The residual
# tells better: where a PSF is wrong, it counts that as noise.
_CLASSES, _DETAIL_CONTRAST, _DETAIL_UNEXPLAINED = 24, 2.0, 0.25


class ResidualNoise(eqx.Module):
    """Noise of captures, relative to the one given.

    - `mistake`: its deviation where there is most of it, as in bright parts; 1 where the data step
      leaves too little to tell, and `tells`: whether it leaves enough everywhere.
    - `grows`: whether it grows with the light, and `variances`: variance of each pixel, over that
      of one of mean light; False and none where the operators are no convolutions, or captures
      small.
    """

    mistake: Float[Array, ""]
    tells: Bool[Array, ""]
    grows: Bool[Array, ""]
    variances: tuple[Float[Array, "..."], ...]


@eqx.filter_jit
def residual_noise(
    normal: AbstractNormal, found: Image, shift: Float[Array, ""], precision: Float[Array, ""]
) -> ResidualNoise:
    """Noise from the residual of z, a data step with μ = `shift` and 1/variance = `precision`."""
    problem = normal.problem
    keys = jax.random.split(jax.random.key(0), len(problem.captures))
    drawn = tuple(
        jnp.where(w > 0, jax.random.normal(key, c.shape, c.dtype) / jnp.sqrt(or_one(w)), 0)
        for key, c, w in zip(keys, problem.captures, problem.weights, strict=True)
    )
    white = eqx.tree_at(lambda p: p.captures, problem, drawn)
    fitted = _roughly(normal.shifted(shift), back_projected(white, drawn))
    seen, known = (_residual_power(p, image) for p, image in ((problem, found), (white, fitted)))
    variance = jnp.where(known > _LEAST_SHARE, precision * seen / or_one(known), 0)
    most = jnp.sqrt(jnp.max(variance))
    trusted = (most > 0) & jnp.isfinite(most)
    mistake = jnp.where(trusted, jnp.clip(most, 1 / _LARGEST_MISTAKE, _LARGEST_MISTAKE), 1)
    tells = jnp.all(known > _LEAST_SHARE)
    if convolutions(problem) is None or variance.ndim == 0:
        return ResidualNoise(mistake, tells, jnp.asarray(False), ())
    return ResidualNoise(mistake, tells, *_growth(problem, found, variance))


def detail_variances(problem: InverseProblem) -> tuple[Float[Array, "..."], ...]:
    """`variances` as the captures' finest detail tells them; none where it shows no a + b·light."""
    if convolutions(problem) is None or not all(map(_has_parts, problem.operators)):
        return ()
    found = []
    for capture, weight in zip(problem.captures, problem.weights, strict=True):
        planes = np.asarray(capture).reshape(-1, *capture.shape[-2:])
        known = np.broadcast_to(np.asarray(weight) > 0, capture.shape).reshape(planes.shape)
        each = []
        for plane, inside in zip(planes, known, strict=True):
            variance = _detail_variance(plane, inside)
            if variance is None:
                return ()
            each.append(variance)
        found.append(jnp.asarray(np.stack(each).reshape(capture.shape), capture.dtype))
    return tuple(found)


def _detail_variance(
    plane: Float[np.ndarray, "y x"], known: Bool[np.ndarray, "y x"]
) -> Float[np.ndarray, "y x"] | None:
    """Variance of a plane's pixels over that of one of mean light."""
    light, detail = details_by_light(plane, known)
    if detail.size < _CLASSES * _SMALLEST**2:
        return None
    level = np.array([part.mean() for part in np.array_split(light, _CLASSES)])
    square = np.array([np.median(part) ** 2 for part in np.array_split(detail, _CLASSES)])
    square = np.maximum(square, 1e-3 * square.max())  # of black that is cut
    if not square.max() > 0:
        return None
    # Relative to each class's own; a is negative above a black level that was left in.
    sides = np.stack([np.ones_like(level), level], axis=-1) / square[:, None]
    (base, slope), *_ = np.linalg.lstsq(sides, np.ones_like(level))
    fitted = base + slope * level
    if not 0 < _DETAIL_CONTRAST * fitted[0] < fitted[-1]:
        return None
    if np.std(square / fitted) > _DETAIL_UNEXPLAINED:
        return None
    seen = scipy.ndimage.uniform_filter(np.where(known, plane, light.mean()), 3)
    return np.maximum((base + slope * seen) / (base + slope * light.mean()), _LEAST_VARIANCE)


def _growth(
    problem: InverseProblem, found: Image, variance: Float[Array, "part part"]
) -> tuple[Bool[Array, ""], tuple[Float[Array, "..."], ...]]:
    """Whether a + b·light explains the variance of parts, and what it gives for each pixel."""
    light = [jnp.maximum(forward(o, found), 0) for o in problem.operators]
    light = [one / or_one(jnp.mean(one)) for one in light]  # a bright capture's noise is known
    parts = _means_of_parts(problem, light)
    # Least squares, neither a nor b negative.
    away = parts - jnp.mean(parts)
    slope = jnp.maximum(jnp.sum(away * variance) / or_one(jnp.sum(away**2)), 0)
    base = jnp.mean(variance) - slope * jnp.mean(parts)
    through = jnp.sum(parts * variance) / or_one(jnp.sum(parts**2))
    base, slope = jnp.maximum(base, 0), jnp.where(base > 0, slope, through)
    fitted = base + slope * parts
    differs = jnp.max(fitted) > _CONTRAST * jnp.min(fitted)
    explained = jnp.std(variance / or_one(fitted)) < _UNEXPLAINED
    each = [(base + slope * one) / or_one(base + slope) for one in light]
    return differs & explained, tuple(jnp.maximum(one, _LEAST_VARIANCE) for one in each)


def _residual_power(problem: InverseProblem, image: Image) -> Array:
    """Means of w (A f − g)² over captures and their parts, of _PARTS along each axis.

    Pixels are averaged with their neighbours before, since captures that were interpolated, such as
    those of two distances, have next to none of their noise at high frequencies.
    """
    powers = []
    parts = zip(problem.operators, residuals(problem, image), problem.weights, strict=True)
    for o, residual, w in parts:
        left = jnp.sqrt(w) * residual
        if _has_parts(o):
            for axis in range(-len(detector_shape(o)), 0):
                left = jnp.moveaxis(left, axis, 0)
                left = jnp.moveaxis((left[1:] + left[:-1]) / 2, 0, axis)
        powers.append(left**2)
    return _means_of_parts(problem, powers)


def _has_parts(operator: AbstractOperator) -> bool:
    return min(detector_shape(operator)) >= _PARTS * _SMALLEST


def _means_of_parts(problem: InverseProblem, values: list[Array]) -> Array:
    """Means over captures, apart by batch and, unless they are small, _PARTS along each axis."""
    means = []
    for operator, value in zip(problem.operators, values, strict=True):
        if not _has_parts(operator):
            means.append(jnp.mean(value))
            continue
        count = len(detector_shape(operator))
        for axis in range(-count, 0):
            value = jnp.moveaxis(value, axis, 0)
            value = value[: len(value) // _PARTS * _PARTS]
            value = value.reshape(_PARTS, -1, *value.shape[1:]).mean(axis=1)
            value = jnp.moveaxis(value, 0, axis)
        means.append(value.mean(axis=tuple(range(value.ndim - count))))
    return sum(means[1:], start=means[0]) / len(means)


def _roughly(normal: AbstractNormal, right: Image) -> Image:
    """The solution to 5 %, which suffices for a mean over all modes."""
    if not isinstance(normal, IterativeNormal):
        return normal.solve(right)
    return normal.solution(right, jnp.zeros_like(right), 5e-2, INNER_STEPS).value
