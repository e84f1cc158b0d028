"""Noise of a capture, estimated from the capture alone."""

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax.imaging.defects import defects, plateau, stuck, wrapped, wrapped_words
from thincam_jax.imaging.operators import AbstractOperator, Separable
from thincam_jax.reconstruction.unseen import unseen_defects

# Standard deviations that a given one is above that found, and the least side of a capture.
_TOO_NOISY, _SMALL = 3.0, 16


def without_unknown(capture: Any) -> tuple[Any, np.ndarray | None]:
    """A capture with 0 for what is masked or NaN, and where it is known; None: everywhere."""
    try:
        array = None if checks.holds_traced(capture) else checks.native(capture)
    except (TypeError, ValueError, RecursionError):  # refused by `as_real`, in words
        return capture, None
    if array is not None and (share := wrapped(array)):
        raise ValueError(f"a capture: {wrapped_words(share)}")
    if array is None or array.dtype.kind != "f" or not (unknown := np.isnan(array)).any():
        return capture, None
    return np.where(unknown, np.zeros((), array.dtype), array), ~unknown


def valid_pixels(
    captures: Sequence[Float[Array, "..."]],
    known: Sequence[np.ndarray | None],
    valid: Sequence[Any] | None,
    operators: Sequence[AbstractOperator | None] | None,
) -> tuple[Bool[Array, "..."], ...] | None:
    """Masks of pixels that are known and valid; None: everywhere.

    How many are masked or NaN is logged as a warning. If captures are to be examined, by their
    `operators`, so are those that are saturated, on a plateau at the largest value of an image, and
    those that most captures find hot or dead.
    """
    masks: list[Any] = list(valid or [np.True_] * len(captures))
    good = [
        np.broadcast_to(True if k is None else k, c.shape)
        for k, c in zip(known, captures, strict=True)
    ]
    _exclude(masks, good, "masked or NaN")
    if operators is not None and not checks.holds_traced((captures, operators)):
        images = [np.asarray(capture) for capture in captures]
        pairs = zip(images, operators, strict=True)
        odd = [_each(image.astype(np.float32), _odd_behind(one)) for image, one in pairs]
        alike = [[other for other in odd if other.shape == one.shape] for one in odd]
        odd = [one & (2 * np.sum(s, axis=0) > len(s)) for one, s in zip(odd, alike, strict=True)]
        _exclude(masks, [~one for one in odd], "hot or dead")
        dim = [np.where(o, c.min(), c) for c, o in zip(images, odd, strict=True)]
        full = [_each(image, _saturated) for image in dim]
        _exclude(masks, [~one for one in full], "saturated, at one largest value")
    if all(mask is np.True_ for mask in masks):
        return None
    return tuple(
        mask if checks.is_traced(mask) else checks.as_array(np.broadcast_to(mask, capture.shape))
        for mask, capture in zip(masks, captures, strict=True)
    )


def _exclude(masks: list[Any], good: Sequence[np.ndarray], why: str) -> None:
    """Exclude from masks what is not `good`; how many pixels that are is logged."""
    lost = 0
    for number, (mask, one) in enumerate(zip(masks, good, strict=True)):
        if one.all():
            continue
        masks[number] = mask & one
        lost += 0 if checks.is_traced(mask) else int(np.count_nonzero(np.asarray(mask) & ~one))
    if lost:
        logging.getLogger(__name__).warning("%d pixels are %s: they are not valid", lost, why)


def _each(image: np.ndarray, find: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    planes = image.reshape(-1, *image.shape[-2:])
    return np.stack([find(plane) for plane in planes]).reshape(image.shape)


def _odd_behind(operator: AbstractOperator | None) -> Callable[[np.ndarray], np.ndarray]:
    """The search for hot and dead pixels in a plane."""
    if isinstance(operator, Separable):
        return lambda plane: defects(plane) | stuck(plane) | unseen_defects(operator, plane)
    return lambda plane: defects(plane) | stuck(plane)


def _saturated(plane: np.ndarray) -> np.ndarray:
    return (plane == plane.max()) & bool(plateau(plane))


# Classes of brightness of a photon-transfer curve, and the least details of one.
_CLASSES, _LEAST = 32, 64
_AT_ENDS = 3  # pixels of a detail that may be as dark, or as bright, as any of the capture
_ENOUGH = 1 << 16  # details, of larger captures
_MEDIAN = 0.6745  # of |x|, if x is normal with standard deviation 1
# Part of a capture's pixels that may be negative anyway, and the greatest root mean square of
# negative pixels by noise, in σ: it is 1 where the scene is black, 0.82 where it darkens evenly.
_NEGATIVE, BY_NOISE = 0.01, 1.4


@jax.jit
def estimate_noise(
    capture: Float[Array, "*batch y x"], valid: Bool[Array, "*batch y x"] | None = None
) -> Float[Array, "*batch"]:
    r"""Root mean square of the noise of a capture, from its finest detail.

    The detail is the second difference along both axes,

    .. math:: d = \sum_{ij} c_i c_j\, g_{ij},\quad c = (1, -2, 1),\qquad \sigma^2 =
        \frac{1}{K} \sum_{k=1}^{K} \Big(\frac{\mathrm{median}_k |d|}{0.6745 \cdot 6}\Big)^2

    (the stencil of Immerkær, Comput. Vis. Image Underst. 64, 300, 1996). The noise of light grows
    with it (the photon-transfer curve), so the medians are those of K equally large classes of
    local brightness, and σ² is the mean variance over the sensor. Where several of the nine pixels
    are as dark as anything in the capture, it is black to the last count, and has classes of its
    own: they show less noise, or none. Details of saturated pixels, as bright as anything, do not
    count, nor do those with a pixel that is not `valid`. Counts are first spread over their step q,
    found from the differences of their values; where it is not black, σ is at least the error of
    rounding, q/√12.

    A lensless capture is smooth at this scale. Where fringes are as fine as pixels the estimate is
    too high; where neighbours share their noise, as after a bilinear demosaicing, it is too low.
    It is 0 for a uniform capture, or one of two values only.
    """
    if min(capture.shape[-2:]) < 3:
        return jnp.zeros(capture.shape[:-2], capture.dtype)
    known = jnp.isfinite(capture) if valid is None else valid & jnp.isfinite(capture)
    least = jnp.min(jnp.where(known, capture, jnp.inf), axis=(-2, -1))
    most = jnp.max(jnp.where(known, capture, -jnp.inf), axis=(-2, -1))
    step = _quantisation_step(jnp.where(known, capture, jnp.inf), most - least)
    windows = _windows(capture)
    black, full = (jnp.sum(windows == e[..., None], axis=0) > _AT_ENDS for e in (least, most))
    shown = jnp.all(_windows(known), axis=0) & ~full
    stencil = jnp.asarray(np.outer((1, -2, 1), (1, -2, 1)).ravel(), capture.dtype)
    detail = jnp.tensordot(stencil, windows, axes=1, precision="highest")
    key = jax.random.key(0)
    spread = jax.random.uniform(key, detail.shape[-1:], detail.dtype, -0.5, 0.5)
    detail = jnp.abs(detail + spread * step[..., None])
    # The median of the rows' medians, which a dead pixel does not move.
    light = _middle(*(_middle(*windows[i : i + 3]) for i in (0, 3, 6)))
    rounding = step**2 / 12
    # What is not black, and what is: at once, for sorting takes long to compile.
    parts = jnp.stack([shown & ~black, shown & black])
    details = jnp.broadcast_to(detail, parts.shape)
    squares = _photon_transfer(jnp.where(parts, light, jnp.inf), details)
    least_variance = jnp.stack([rounding, jnp.zeros_like(rounding)])
    own = jnp.maximum((squares - rounding) / jnp.sum(stencil**2), least_variance)
    count = jnp.sum(parts, axis=-1).astype(step.dtype)
    variance, count = jnp.sum(count * own, axis=0), jnp.sum(count, axis=0)
    return jnp.where(step > 0, jnp.sqrt(variance / jnp.maximum(count, 1)), 0)


def demosaiced_noise(
    capture: Float[Array, "channel y x"], valid: Bool[Array, "channel y x"]
) -> Float[Array, ""]:
    """Root mean square of the noise of a bilinearly demosaiced capture, 0 if none is found.

    Neighbours share their noise, but every second pixel has its own, largest where the colour was
    measured: `estimate_noise` of the four subsets of each colour, the largest, averaged over
    colours.
    """
    parts = [np.s_[:, i::2, j::2] for i in range(2) for j in range(2)]
    each = jnp.stack([estimate_noise(capture[part], valid[part]) for part in parts])
    return jnp.sqrt(jnp.mean(jnp.max(each, axis=0) ** 2))


def details_by_light(
    plane: Float[np.ndarray, "y x"], valid: Bool[np.ndarray, "y x"]
) -> tuple[Float[np.ndarray, " detail"], Float[np.ndarray, " detail"]]:
    """Mean light of 3×3 pixels, all valid, and their detail's size, the darkest first."""
    detail, light, known = plane, plane, valid
    for axis in (0, 1):  # one after the other takes half the time of both at once
        detail = np.diff(detail, 2, axis)
        light = sliding_window_view(light, 3, axis).mean(axis=-1)
        known = np.asarray(sliding_window_view(known, 3, axis).all(axis=-1))
    light, detail = light[known], np.abs(detail[known])
    order = np.argsort(light)
    return light[order], detail[order]


def local_noise(capture: Float[Array, "..."], valid: Bool[Array, "..."]) -> Float[Array, "..."]:
    """The noise around each pixel over its root mean square, from the finest detail of 9×9 pixels.

    1 everywhere in captures that are not images, or uniform.
    """
    if capture.ndim < 2 or min(capture.shape[-2:]) < 3:
        return jnp.ones_like(capture)
    border = [(0, 0)] * (capture.ndim - 2) + [(1, 1)] * 2
    detail = jnp.abs(jnp.diff(jnp.diff(capture, n=2, axis=-1), n=2, axis=-2))
    detail = jnp.where(valid, jnp.pad(detail, border, mode="edge"), 0)
    around, known = (
        jax.lax.reduce_window(
            a, 0.0, jax.lax.add, (1,) * (a.ndim - 2) + (9, 9), (1,) * a.ndim, "SAME"
        )
        for a in (detail, valid.astype(capture.dtype))
    )
    noise = around / jnp.maximum(known, 1)
    mean = jnp.mean(noise**2, where=valid)
    return jnp.where(mean > 0, noise / jnp.sqrt(jnp.where(mean > 0, mean, 1)), 1)


def _stride(image: Array) -> int:
    return max(1, math.isqrt(image.shape[-2] * image.shape[-1] // _ENOUGH))


def _windows(image: Array) -> Array:
    """The 3×3 pixels around every pixel, or fewer of a large image: (9, *batch, window)."""
    rows, columns = (n - 2 for n in image.shape[-2:])
    n = _stride(image)
    parts = [image[..., i : i + rows : n, j : j + columns : n] for i in range(3) for j in range(3)]
    return jnp.stack(parts).reshape(9, *image.shape[:-2], -1)


def _middle(a: Array, b: Array, c: Array) -> Array:
    return jnp.maximum(jnp.minimum(a, b), jnp.minimum(jnp.maximum(a, b), c))


def _quantisation_step(values: Float[Array, "*batch y x"], span: Float[Array, "*batch"]):
    """The usual least distance of two different values, of those that are finite.

    The tenth part of the distances, and the smallest of all, may be less: where a background that
    is no whole number of counts has been subtracted, zero is nearer to its neighbour. 0 of fewer
    than three values.
    """
    n = _stride(values)
    every = values[..., ::n, ::n]
    gaps = jnp.diff(jnp.sort(every.reshape(*every.shape[:-2], -1)))
    rounding = 4e-6  # of single precision; the last of 16 bits is 1.5e-5
    steps = jnp.isfinite(gaps) & (gaps > rounding * span[..., None])
    count = jnp.sum(steps, axis=-1)
    index = jnp.clip(1 + count // 10, 0, jnp.maximum(count - 1, 0))
    found = _at(jnp.sort(jnp.where(steps, gaps, jnp.inf)), index[..., None])[..., 0]
    return jnp.where(count > 1, found, 0)


def _photon_transfer(brightness: Float[Array, "*batch n"], detail: Float[Array, "*batch n"]):
    """Mean over classes of brightness of the variance of the details; infinite ones are left out.

    Two sorts for any number of classes: by brightness, then by class and size.
    """
    brightness, detail = jax.lax.sort((brightness, detail), num_keys=1)
    count = jnp.sum(jnp.isfinite(brightness), axis=-1)
    classes = jnp.clip(count // _LEAST, 1, _CLASSES)
    total = jnp.maximum(count, 1)
    rank = jnp.arange(detail.shape[-1])
    number = jnp.where(rank < count[..., None], rank * classes[..., None] // total[..., None], 99)
    _, detail = jax.lax.sort((number, detail), num_keys=2)
    # (*batch, class)
    k, total, of = jnp.arange(_CLASSES), total[..., None], classes[..., None]
    first, last = -(-k * total // of), -(-(k + 1) * total // of) - 1
    middle = (_at(detail, (first + last) // 2) + _at(detail, (first + last + 1) // 2)) / 2
    squares = jnp.sum(jnp.where(k < of, (middle / _MEDIAN) ** 2, 0), axis=-1)
    return jnp.where(count > 0, squares / classes.astype(detail.dtype), 0)


def _at(values: Array, index: Array) -> Array:
    return jnp.take_along_axis(values, index, axis=-1, mode="clip")


def estimate_variance(
    captures: Sequence[Float[Array, "*batch y x"]] | Float[Array, "capture *batch y x"],
    valid: Sequence[Bool[Array, "*batch y x"]] | Bool[Array, "capture *batch y x"] | None = None,
) -> Float[Array, " capture"]:
    """Variance of each capture's noise, averaged over its batch.

    A capture without any is taken to have noise of a thousandth of the root mean square of all, so
    that what depends on the estimate scales with the captures; of 1 if they are all zero.
    """
    masks = [None] * len(captures) if valid is None else valid
    deviations = [estimate_noise(c, m) for c, m in zip(captures, masks, strict=True)]
    return _variances(deviations, list(captures))


def too_noisy(captures: Sequence[Any], valid: Sequence[Any] | None, given: Any) -> str:
    """A sentence where a variance was given far above that of the finest detail, else nothing.

    Detail of a fine code is taken for noise, so that the estimate is too large rather than small.
    """
    if given is None or checks.holds_traced((captures, valid, given)):
        return ""
    if any(one.ndim < 2 or min(one.shape[-2:]) < _SMALL for one in captures):
        return ""
    variances = np.broadcast_to(np.asarray(given_variances(given, captures)), len(captures))
    found = np.asarray(estimate_variance(captures, valid))
    if not (variances > _TOO_NOISY**2 * found).any():
        return ""
    n = int(np.argmax(variances / found))
    return (
        f"noise_variance is too large: {variances[n]:.3g} of which {found[n]:.3g} is found; leave "
        "it out"
    )


@jax.jit
def _variances(deviations, captures):
    """Variances of deviations; (root mean square of all captures / 1000)² in place of 0."""
    found = jnp.stack([jnp.mean(d**2) for d in deviations])
    least = 1e-6 * jnp.mean(jnp.stack([jnp.mean(c**2) for c in captures]))
    return jnp.where(found > 0, found, jnp.where(least > 0, least, 1))


def square_below_black(capture: Float[Array, "*batch y x"]) -> float:
    """Mean square of a known capture's negative pixels, 0 where they are 1 % or fewer."""
    light = np.asarray(capture)
    below = light[light < 0]
    is_dark = below.size > _NEGATIVE * light.size
    return float(np.mean(np.square(below, dtype=np.float64))) if is_dark else 0.0


def given_variances(
    noise_variance: Numbers | Sequence[Number],
    captures: Sequence[Float[Array, "..."]] | Float[Array, "capture ..."],
) -> Float[Array, " capture"]:
    """The variance given, of each capture, averaged over its batch."""
    count = len(captures)
    each = checks.array("noise_variance", noise_variance)
    numpy = jnp if checks.is_traced(each) else np
    each = numpy.asarray(each, captures[0].dtype)
    known = 0 if checks.is_traced(each) else each
    if not np.all((known >= 0) & np.isfinite(known)):
        raise ValueError(
            f"noise_variance = {checks.shown(noise_variance)} is negative or not finite; give "
            "variances in the captures' units squared, or none to have them estimated"
        )
    if each.ndim and each.shape[0] != count:
        raise ValueError(
            f"noise_variance has shape {each.shape}; give one number or one for each of the "
            f"{count} captures"
        )
    each = numpy.broadcast_to(each.reshape(each.shape or (1,)), (count, *each.shape[1:]))
    return checks.as_array(numpy.mean(each.reshape(count, -1), axis=1))
