"""What a regularised reconstruction minimises."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.total_variation import TotalVariation


class Deconvolution(eqx.Module):
    r"""Captures g_k of one image f through crop-convolutions, and what is wanted of the image.

    .. math:: E(f) = \tfrac12 \sum_k \big\|\sqrt{w_k}\,(H_k f - g_k)\big\|^2 + \tau\, TV(f),
        \qquad f \ge 0

    (thesis Eq 5.11 with the crop of the sensor in H).

    **Arguments**

    - `operators`: one for each capture, on one window and one field. Their spectra have the shape
      (channel or 1, plane, v, u), the planes summed.
    - `captures`: g_k, (*batch, channel, y, x).
    - `weights`: w_k that broadcast to the captures: 1/variance up to a common factor, 0 where a
      pixel is dead or saturated.
    - `tau`: τ, in units of captures × operator.
    - `variation`: what TV is.
    - `nonnegative`: whether f ≥ 0 is asked.
    """

    operators: tuple[CropConvolution, ...]
    captures: tuple[Float[Array, "*batch channel y x"], ...]
    weights: tuple[Float[Array, "..."], ...]
    tau: Float[Array, ""]
    variation: TotalVariation
    nonnegative: bool = eqx.field(static=True)

    def __init__(
        self,
        operators,
        captures,
        *,
        tau,
        weights=None,
        variation: TotalVariation | None = None,
        nonnegative: bool = True,
    ):
        self.operators = tuple(operators)
        self.captures = tuple(_floating(c) for c in captures)
        _check_operators(self.operators, self.captures)
        given = [1.0] * len(self.captures) if weights is None else list(weights)
        if len(given) != len(self.captures):
            raise ValueError(
                f"{len(given)} weights for {len(self.captures)} captures; give one for each"
            )
        self.weights = tuple(
            jnp.asarray(w, dtype=c.dtype) for w, c in zip(given, self.captures, strict=True)
        )
        self.tau = checks.non_negative("tau", tau, "units of captures times operator").astype(
            self.captures[0].dtype
        )
        self.variation = TotalVariation() if variation is None else variation
        self.nonnegative = nonnegative

    @property
    def field_shape(self) -> tuple[int, int]:
        return self.operators[0].field_shape

    @property
    def window(self) -> tuple[int, int]:
        return self.operators[0].window

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of the image: (*batch, channel, plane, y, x)."""
        planes = self.operators[0].spectrum.shape[-3]
        return (*self.captures[0].shape[:-2], planes, *self.field_shape)


def residuals(problem: Deconvolution, image: Float[Array, "*batch channel plane y x"]):
    """H_k f − g_k of every capture."""
    return tuple(
        operator(image) - capture
        for operator, capture in zip(problem.operators, problem.captures, strict=True)
    )


def misfit(problem: Deconvolution, image: Float[Array, "*batch channel plane y x"]):
    """½ Σ w (H f − g)² of each member of the batch."""
    parts = [
        jnp.sum(w * r**2, axis=(-3, -2, -1))
        for w, r in zip(problem.weights, residuals(problem, image), strict=True)
    ]
    return sum(parts) / 2


def objective(
    problem: Deconvolution, image: Float[Array, "*batch channel plane y x"]
) -> Float[Array, "*batch"]:
    """E(f) of each member of the batch; it says nothing of f ≥ 0."""
    return misfit(problem, image) + problem.tau * problem.variation(image)


def uniform_level(problem: Deconvolution) -> Float[Array, "*batch channel"]:
    """The brightness of an even image that explains each channel best, by least squares."""
    even = jnp.ones(problem.image_shape[-4:], problem.captures[0].dtype)
    seen, light = 0.0, 0.0
    for operator, capture, weight in zip(
        problem.operators, problem.captures, problem.weights, strict=True
    ):
        flat = operator(even)
        seen = seen + jnp.sum(weight * flat * capture, axis=(-2, -1))
        light = light + jnp.sum(weight * flat * flat, axis=(-2, -1))
    light = jnp.broadcast_to(light, jnp.shape(seen))
    return jnp.where(light > 0, seen / jnp.where(light > 0, light, 1), 0)


def _floating(capture) -> Array:
    """Raw counts are taken as they are, but as real numbers."""
    capture = jnp.asarray(capture)
    return capture if jnp.issubdtype(capture.dtype, jnp.floating) else capture.astype(float)


def _check_operators(operators, captures) -> None:
    if not operators or len(operators) != len(captures):
        raise ValueError(
            f"{len(captures)} captures for {len(operators)} operators; give one operator for each"
        )
    layouts = {(o.window, o.field_shape, o.summed, o.spectrum.shape[-3]) for o in operators}
    if len(layouts) > 1 or operators[0].summed != 1:
        raise ValueError(
            "operators differ in window, field or planes; give CropConvolutions of kernels "
            "(channel, plane, k, l) with summed=1 and one window"
        )
    leading = {capture.shape[:-2] for capture in captures}
    if len(leading) > 1:
        raise ValueError(
            f"captures differ in batch or channels: {sorted(leading)}; they show one image"
        )
    for operator, capture in zip(operators, captures, strict=True):
        channels = operator.spectrum.shape[0] if operator.spectrum.ndim == 4 else 0
        if capture.ndim < 3 or capture.shape[-2:] != operator.sensor_shape:
            raise ValueError(
                f"a capture has shape {capture.shape}; its operator takes (…, channel, y, x) with "
                f"(y, x) = {operator.sensor_shape}"
            )
        if channels not in (1, capture.shape[-3]):
            raise ValueError(
                f"a capture has {capture.shape[-3]} channels and its PSF {channels}; give a PSF "
                "of 1 channel or of as many"
            )
