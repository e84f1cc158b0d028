"""The inverse problem of a reconstruction, for any camera with a linear operator."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.precision import product
from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators import AbstractOperator, CropConvolution, Masked, Stacked
from thincam_jax.imaging.operators.base import is_shape
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.imaging.operators.separable import Separable
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image
from thincam_jax.reconstruction.total_variation import TotalVariation

Background = Literal["known", "unknown", "nonnegative"]


class InverseProblem(eqx.Module):
    r"""Regularised least squares for an image f of captures g_k through linear operators A_k.

    .. math:: E(f) = \tfrac12 \sum_k \big\|\sqrt{w_k}\,(A_k f - g_k)\big\|^2 + \tau\,u\,R(f),
        \qquad f \ge 0

    (thesis Eq 5.11 with the crop of the sensor in A). Images have the axes (*batch, channel, plane,
    y, x). An operator whose `in_shape` is (y, x) or (plane, y, x) applies to every channel; one of
    (channel, plane, y, x) has a capture that begins with the channel.

    τ is relative. Its unit u is the standard deviation of a pixel of the back-projected noise
    Σ Aᵀwn, if the weights are 1/variance:

    .. math:: u = \Big(\sum_k \max(w_k)\,\|A_k\|_F^2 / N\Big)^{1/2}

    with N numbers in the image. At τ = 1 a step between two pixels costs as much as noise alone
    gains by it; 1 to 3 suit most scenes and all cameras.

    **Arguments**

    - `operators`: one for each capture, or one `Stacked`. `Stacked`, `Masked` and `Scaled` are
      resolved into their operators, captures and weights, so that solvers can use the structure.
      Masked pixels get weight 0.
    - `captures`: g_k, (*batch, channel, …), then the axes of the operator's capture.
    - `weights`: w_k that broadcast to the captures: 1/variance up to a common factor, 0 where a
      pixel is dead or saturated; default 1.
    - `tau`: τ ≥ 0, relative.
    - `regulariser`: R; default isotropic total variation.
    - `nonnegative`: whether to constrain f ≥ 0.
    - `background`: "known" if the captures have none left. If "unknown", a uniform background b_k
      of each capture and channel is added to A_k f: for every f the best one, the weighted mean of
      g_k − A_k f. If "nonnegative", it is 0 where that mean is negative; linear methods ignore
      this constraint.

    **Errors**: ValueError, one line, where operators and captures do not fit.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]), noise_variance=0.01)
    problem = recording.problem(tau=2.0)
    print(problem.image_shape)  # (1, 1, 32, 40)
    ```

    **See also**: `Recording`, `reconstruction.solve_fixed_point`.
    """

    operators: tuple[AbstractOperator, ...]
    captures: tuple[Float[Array, "..."], ...]
    weights: tuple[Float[Array, "..."], ...]
    tau: Float[Array, ""]
    tau_unit: Float[Array, ""]
    regulariser: AbstractRegulariser
    nonnegative: bool = eqx.field(static=True)
    background: Background = eqx.field(static=True)

    def __init__(
        self,
        operators: AbstractOperator | Sequence[AbstractOperator],
        captures: Numbers | Sequence[Any],
        *,
        weights: Sequence[Any] | None = None,
        tau: Number = 2.0,
        regulariser: AbstractRegulariser | None = None,
        nonnegative: bool = True,
        background: Background = "known",
    ):
        operators = [operators] if isinstance(operators, AbstractOperator) else list(operators)
        captures = list(captures) if isinstance(captures, tuple | list) else [captures]
        if len(operators) == 1 and isinstance(operators[0], Stacked) and len(captures) > 1:
            operators = list(operators[0].operators)
        if not operators or len(operators) != len(captures):
            raise ValueError(
                f"{len(captures)} captures for {len(operators)} operators; give one operator for "
                "each"
            )
        given = [1.0] * len(captures) if weights is None else list(weights)
        if len(given) != len(captures):
            raise ValueError(
                f"{len(given)} weights for {len(captures)} captures; give one for each"
            )
        parts = [
            part for one in zip(operators, captures, given, strict=True) for part in _plain(*one)
        ]
        self.operators = tuple(o for o, _, _ in parts)
        self.captures = tuple(as_real(c) for _, c, _ in parts)
        self.weights = tuple(
            jnp.asarray(w, dtype=c.dtype) for (_, _, w), c in zip(parts, self.captures, strict=True)
        )
        _check_operators(self.operators, self.captures)
        dtype = self.captures[0].dtype
        self.tau = checks.non_negative("tau", tau, "a ratio").astype(dtype)
        self.tau_unit = backprojected_noise(self.operators, self.weights).astype(dtype)
        self.regulariser = TotalVariation() if regulariser is None else regulariser
        self.nonnegative, self.background = nonnegative, background

    @property
    def has_background(self) -> bool:
        """Whether there is a background to find."""
        return self.background != "known"

    @property
    def absolute_tau(self) -> Float[Array, ""]:
        """τ·u, the weight of R(f) in E, in units of captures × operator × weight."""
        return self.tau * self.tau_unit

    @property
    def field_shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        rows, columns = self.operators[0].in_shape[-2:]
        return rows, columns

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of the image: (*batch, channel, plane, y, x)."""
        first = self.operators[0]
        planes = first.in_shape[-3] if len(first.in_shape) > 2 else 1
        leading = self.captures[0].shape[: self.captures[0].ndim - len(detector_shape(first))]
        return (*leading, planes, *self.field_shape)


@quickly_compiled
def backprojected_noise(
    operators: Sequence[AbstractOperator], weights: Sequence[Float[Array, "..."]]
) -> Float[Array, ""]:
    """u of `InverseProblem`: the standard deviation of a pixel of the back-projected noise."""
    parts = [o.mean_power() * jnp.max(w) for o, w in zip(operators, weights, strict=True)]
    return jnp.sqrt(sum(parts[1:], start=parts[0]))


def detector_shape(operator: AbstractOperator) -> tuple[int, ...]:
    """The axes of a capture after batch and channel."""
    return operator.out_shape[1:] if len(operator.in_shape) == 4 else operator.out_shape


def forward(operator: AbstractOperator, image: Float[Array, "..."]) -> Float[Array, "..."]:
    """A f of an image (*batch, channel, plane, y, x), uniform if its last axes are (1, 1, 1)."""
    whole = (1, 1, *operator.in_shape)[-4:]
    if image.shape[-3:] == (1, 1, 1) != whole[1:]:
        if isinstance(operator, Separable):
            rows, columns = operator.left.sum(axis=2), operator.right.sum(axis=2)
            flat = product(rows.T, columns)[None]
        else:
            flat = forward(operator, jnp.ones(whole, image.dtype))
        return image.reshape(*image.shape[:-3], *(1,) * (flat.ndim - 1)) * flat
    return operator(image[..., 0, :, :] if len(operator.in_shape) == 2 else image)


def back_project(operator: AbstractOperator, capture: Float[Array, "..."]) -> Float[Array, "..."]:
    """Aᵀ g with the axes of an image."""
    image = operator.adjoint(capture)
    return image[..., None, :, :] if len(operator.in_shape) == 2 else image


def residuals(problem: InverseProblem, image: Image):
    """A_k f + b_k − g_k of every capture, with the background b_k that fits best."""
    parts = zip(problem.operators, problem.captures, problem.weights, strict=True)
    return tuple(
        with_background(problem.background, w, forward(o, image) - g, len(detector_shape(o)))
        for o, g, w in parts
    )


def with_background(
    background: Background,
    weight: Float[Array, "..."],
    difference: Float[Array, "..."],
    axes: int,
    highest: Float[Array, "..."] | float = math.inf,
) -> Float[Array, "..."]:
    """A f + b − g of the difference A f − g, over its last axes.

    - `highest`: upper limit of b.
    """
    if background == "known":
        return difference
    level = jnp.maximum(weighted_mean(weight, difference, axes), -highest)
    return difference - (jnp.minimum(level, 0) if background == "nonnegative" else level)


def lit(problem: InverseProblem, image: Image) -> tuple[Bool[Array, "..."], ...]:
    """Whether the background of each capture that fits an image best is positive."""
    parts = zip(problem.operators, problem.captures, problem.weights, strict=True)
    return tuple(
        weighted_mean(w, forward(o, image) - g, len(detector_shape(o))) < 0 for o, g, w in parts
    )


def without_background(
    problem: InverseProblem,
    differences: Sequence[Float[Array, "..."]],
    lit: Sequence[Bool[Array, "..."]] | None = None,
) -> tuple[Float[Array, "..."], ...]:
    """Captures less their means by the weights, where there is a background to find.

    - `lit`: captures that have one, by default all.
    """
    if not problem.has_background:
        return tuple(differences)
    parts = zip(problem.operators, problem.weights, differences, strict=True)
    found = tuple(with_background("unknown", w, d, len(detector_shape(o))) for o, w, d in parts)
    return found if lit is None else tuple(map(jnp.where, lit, found, differences))


def weighted_mean(
    weight: Float[Array, "..."], capture: Float[Array, "..."], axes: int
) -> Float[Array, "..."]:
    """Mean over the last axes, which keep the length 1; 0 where all weights are."""
    last = tuple(range(-axes, 0))
    if weight.shape[-axes:] in ((), (1,) * axes):  # uniform: half of the sums
        return jnp.where(weight > 0, jnp.mean(capture, axis=last, keepdims=True), 0)
    whole = jnp.broadcast_to(weight, jnp.broadcast_shapes(weight.shape, capture.shape))
    total = jnp.sum(whole, axis=last, keepdims=True)
    return jnp.sum(whole * capture, axis=last, keepdims=True) / or_one(total)


def back_projected(
    problem: InverseProblem,
    differences: Sequence[Float[Array, "..."]],
    lit: Sequence[Bool[Array, "..."]] | None = None,
) -> Float[Array, "..."]:
    r""":math:`\sum_k A_k^T w_k d_k`, of captures without their background."""
    return _spread(problem, without_background(problem, differences, lit))


def _spread(problem: InverseProblem, differences: Sequence[Float[Array, "..."]]):
    parts = zip(problem.operators, problem.weights, differences, strict=True)
    first, *others = [back_project(operator, w * d) for operator, w, d in parts]
    return sum(others, start=first)


def gradient(problem: InverseProblem, image: Image):
    r"""Gradient of the misfit, :math:`\sum_k A_k^T w_k (A_k f - g_k)`."""
    return _spread(problem, residuals(problem, image))


def misfit(problem: InverseProblem, image: Image):
    """½ Σ w (A f − g)² of each batch element."""
    parts = [
        jnp.sum(w * r**2, axis=tuple(range(-1 - len(detector_shape(o)), 0)))
        for o, w, r in zip(
            problem.operators, problem.weights, residuals(problem, image), strict=True
        )
    ]
    return sum(parts[1:], start=parts[0]) / 2


def objective(problem: InverseProblem, image: Image) -> Float[Array, "*batch"]:
    """E(f) of each batch element, without the constraint f ≥ 0."""
    return misfit(problem, image) + problem.absolute_tau * problem.regulariser(image)


# Outside of compiled programs, as between two chunks of iterations.
compiled_objective = jax.jit(objective)


@jax.jit
def relative_residual(problem: InverseProblem, image: Image) -> Float[Array, ""]:
    """‖Af − g‖/‖g‖ over the pixels of positive weight."""
    parts = list(zip(residuals(problem, image), problem.captures, problem.weights, strict=True))
    missing, known = (
        jnp.concatenate([jnp.where(w > 0, part[n], 0).ravel() for *part, w in parts])
        for n in (0, 1)
    )
    return jnp.linalg.norm(missing) / jnp.linalg.norm(known)


def total_misfit(image: Image, problem: InverseProblem) -> Float[Array, ""]:
    """½ Σ w (A f − g)² over the batch, for `optimistix.minimise(total_misfit, …, args=problem)`."""
    return jnp.sum(misfit(problem, image))


def total_objective(image: Image, problem: InverseProblem) -> Float[Array, ""]:
    """E(f) over the batch, for `optimistix.minimise(total_objective, …, args=problem)`."""
    return jnp.sum(objective(problem, image))


def with_tau(problem: InverseProblem, tau: Number) -> InverseProblem:
    """This problem with another relative τ."""
    return eqx.tree_at(lambda p: p.tau, problem, jnp.asarray(tau, problem.tau.dtype))


# Part of the squares of a uniform image's capture that must not be uniform to show its brightness.
UNEVEN = 1e-3


def uniform_level(
    problem: InverseProblem, *, has_background: bool | None = None
) -> Float[Array, "*batch channel"]:
    r"""The brightness of a uniform image that explains each channel best, by least squares.

    - `has_background`: whether to leave room for a background; default: as the problem does.

    Where a background would explain it as well, the brightness is that of an image of full
    contrast: between :math:`\sigma_g/\sum h`, where its detail is coarser than the PSF h, and
    :math:`\sigma_g/(\sum h^2)^{1/2}`, where its pixels vary independently, the geometric mean.
    """
    seen, light = 0.0, 0.0
    has_background = problem.has_background if has_background is None else has_background
    for operator, capture, weight in zip(
        problem.operators, problem.captures, problem.weights, strict=True
    ):
        axes = tuple(range(-len(detector_shape(operator)), 0))
        flat = forward(operator, jnp.ones((1,) * 4, capture.dtype))
        if has_background:
            whole, uneven = flat, flat - weighted_mean(weight, flat, len(axes))
            even = weighted_mean(weight, flat**2, len(axes))
            shown = weighted_mean(weight, uneven**2, len(axes)) > UNEVEN * even
            capture = capture - weighted_mean(weight, capture, len(axes))
            spread = jnp.sqrt(weighted_mean(weight, capture**2, len(axes)))
            gain = jnp.sqrt(or_one(jnp.sqrt(even * operator.mean_power())))
            flat = jnp.where(shown, uneven, whole)
            capture = jnp.where(shown, capture, spread / gain * whole)
        elif isinstance(operator, Separable) and weight.size == 1:  # by products, which are faster
            rows, columns = operator.left.sum(axis=2), operator.right.sum(axis=2)
            seen = seen + weight.reshape(()) * jnp.sum(product(rows, capture) * columns, axis=axes)
            light = light + jnp.sum(weight * flat * flat, axis=axes)
            continue
        seen = seen + jnp.sum(weight * flat * capture, axis=axes)
        light = light + jnp.sum(weight * flat * flat, axis=axes)
    light = jnp.broadcast_to(light, jnp.shape(seen))
    return jnp.where(light > 0, seen / jnp.where(light > 0, light, 1), 0)


def scene_level(problem: InverseProblem) -> Float[Array, "*batch channel"]:
    """The uniform brightness of the scene: a background that is not negative takes none away."""
    level = uniform_level(problem)
    if problem.background != "nonnegative":
        return level
    return jnp.minimum(level, uniform_level(problem, has_background=False))


compiled_level = quickly_compiled(scene_level)


@quickly_compiled
def uniform_image(problem: InverseProblem) -> Image:
    """The non-negative uniform image that explains the captures best, a good start image."""
    level = jnp.maximum(scene_level(problem), 0)[..., None, None, None]
    return jnp.broadcast_to(level, problem.image_shape)


def start_image(problem: InverseProblem, image: Float[Array, "..."] | None) -> Image:
    """Check a start image; by default the uniform one."""
    if image is None:
        return uniform_image(problem)
    if image.shape != problem.image_shape:
        raise ValueError(
            f"the start image has shape {image.shape}; give (…, channel, plane, y, x) = "
            f"{problem.image_shape}"
        )
    return jnp.asarray(image, problem.captures[0].dtype)


def convolutions(problem: InverseProblem) -> tuple[CropConvolution, ...] | None:
    """The operators if all are convolutions on one window, diagonal in the Fourier domain."""
    found = tuple(o for o in problem.operators if isinstance(o, CropConvolution))
    layouts = {(o.window, o.field_shape, o.spectrum.shape[-3]) for o in found}
    return found if len(found) == len(problem.operators) and len(layouts) == 1 else None


def _plain(operator: AbstractOperator, capture, weight) -> list[tuple]:
    """(operator, capture, weight) of every capture, without `Stacked`, `Masked` and `Scaled`."""
    if isinstance(operator, Stacked):
        count = len(operator.operators)
        parts = zip(operator.operators, _each(capture, count), _each(weight, count), strict=True)
        return [plain for part in parts for plain in _plain(*part)]
    if isinstance(operator, Masked | Scaled):
        change = _masked if isinstance(operator, Masked) else _rescaled
        values = operator.valid if isinstance(operator, Masked) else operator.gain
        if is_shape(operator.out_shape):
            return _plain(operator.operator, *change(capture, weight, values))
        count = len(operator.out_shape)
        pairs = zip(*(_each(v, count) for v in (capture, weight, values)), strict=True)
        captures, weights = zip(*(change(*pair) for pair in pairs), strict=True)
        return _plain(operator.operator, captures, weights)
    if isinstance(operator, CropConvolution):
        operator = operator.with_channels_and_planes()
    return [(operator, capture, weight)]


def _masked(capture, weight, valid):
    """Capture and weight with masked pixels, which may be NaN, set to 0."""
    return jnp.where(valid, jnp.asarray(capture), 0), jnp.where(valid, weight, 0)


def _rescaled(capture, weight, gain):
    """Capture and weight without the gain: w (c A f − g)² = w c² (A f − g/c)²."""
    inverse = jnp.where(gain == 0, 0, 1 / jnp.where(gain == 0, 1, gain))
    return capture * inverse, weight * gain**2


def _each(value, count: int) -> list:
    return list(value) if isinstance(value, tuple | list) else [value] * count


def as_real(capture: Any) -> Float[Array, "..."]:
    """A capture as floating-point numbers, raw counts unscaled; complex numbers are refused."""
    return checks.as_array(checks.array("a capture", capture), floating=True)


def _check_operators(operators, captures) -> None:
    fields = {(*o.in_shape[-3:-2], *o.in_shape[-2:]) for o in operators}
    for operator in operators:
        if not 2 <= len(operator.in_shape) <= 4:
            raise ValueError(
                f"a {type(operator).__name__} takes images {operator.in_shape}; give it an "
                "in_shape (y, x), (plane, y, x) or (channel, plane, y, x)"
            )
    if len(fields) > 1:
        raise ValueError(
            f"operators take images of shapes {sorted(fields)}; they see one image, so give "
            "operators of one field and as many planes"
        )
    leading = set()
    for operator, capture in zip(operators, captures, strict=True):
        detector = detector_shape(operator)
        if capture.ndim <= len(detector) or capture.shape[-len(detector) :] != detector:
            raise ValueError(
                f"a capture has shape {capture.shape}; its operator takes (…, channel, "
                f"{', '.join(map(str, detector))})"
            )
        leading.add(capture.shape[: capture.ndim - len(detector)])
        channels = operator.out_shape[0] if len(operator.in_shape) == 4 else 1
        if channels not in (1, capture.shape[-len(detector) - 1]):
            raise ValueError(
                f"a capture has {capture.shape[-len(detector) - 1]} channels and its PSF "
                f"{channels}; give a PSF of 1 channel or of as many"
            )
    if len(leading) > 1:
        raise ValueError(
            f"captures differ in batch or channels: {sorted(leading)}; they show one image"
        )


def or_one(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """The value where it is positive, else 1: a safe divisor."""
    return jnp.where(value > 0, value, 1)


@jax.jit
def brightness(image: Float[Array, "..."]) -> Float[Array, ""]:
    """Mean of f weighted by f², Σ f³/Σ f² over f > 0, in which dark surroundings do not count."""
    bright = jnp.maximum(image, 0)
    return jnp.sum(bright**3) / or_one(jnp.sum(bright**2))
