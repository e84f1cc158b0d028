"""Spectra of scene and noise that the Wiener synthesis weighs against each other.

All are per sample: a white image of variance σ² has the spectrum σ² at every frequency. They lie on
the half plane of a real DFT of the padded window.
"""

import functools
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core.grids import Grid

Prior = Literal["inverse_square", "flat"]


@functools.partial(jax.jit, static_argnames=("prior", "field_shape"))
def prior_spectrum(prior: Prior, grid: Grid, field_shape: tuple[int, int]) -> Float[Array, "v u"]:
    """Scene spectrum with a mean of 1 over all frequencies."""
    v = jnp.fft.ifftshift(grid.v)[:, None]
    u = jnp.fft.ifftshift(grid.u)
    if prior == "flat":
        return jnp.ones((v.shape[0], grid.shape[1] // 2 + 1), v.dtype)
    corner = 1 / (max(field_shape) * grid.pitch)
    spectrum = 1 / (u**2 + v**2 + corner**2)
    return (spectrum / jnp.mean(spectrum))[:, : grid.shape[1] // 2 + 1]


def _axis_distance(padded, sensor_shape) -> tuple[np.ndarray, np.ndarray]:
    """|v| and |u| in units of the frequency of one cycle over the sensor."""
    v = np.abs(np.fft.fftfreq(padded[0])) * sensor_shape[0]
    u = np.fft.rfftfreq(padded[1]) * sensor_shape[1]
    return v[:, None], u[None, :]


def inner_band(padded: Sequence[int], sensor_shape: Sequence[int | float]) -> np.ndarray:
    """Frequencies away from both axes, where the sensor's edges leave no trace."""
    v, u = _axis_distance(padded, sensor_shape)
    inner = (v > 3) & (u > 3)
    return inner if inner.any() else np.ones_like(inner)  # a sensor of a few rows has no others


def scene_power(
    signal: Float[Array, "channel v u"],
    expected: Float[Array, "channel v u"],
    inner: Bool[np.ndarray, "v u"],
) -> Float[Array, ""]:
    """Variance of the scene: least-squares fit of its expected power to the captures' own.

    Weighted by what is expected, so that it rests on frequencies where the scene stands out.
    """
    weight = jnp.where(inner, expected, 0.0)
    floor = 1e-6 * jnp.sum(weight * jnp.abs(signal))
    return jnp.maximum(jnp.sum(weight * signal), floor) / jnp.sum(weight * expected)


def crop_noise(
    periodogram: Float[Array, "channel v u"],
    padded: Sequence[int],
    sensor_shape: Sequence[int | float],
) -> Float[Array, "channel v u"]:
    """Noise spectrum of the steps that a bright background leaves at the sensor's borders.

    A step across the border x = const has a spectrum that falls like 1/u² from the v axis; its
    strength is read off that axis, row by row, and so for the other border.
    """
    v, u = _axis_distance(padded, sensor_shape)
    on_v = jnp.mean(
        periodogram, axis=-1, where=np.broadcast_to(u <= 1, periodogram.shape), keepdims=True
    )
    on_u = jnp.mean(
        periodogram, axis=-2, where=np.broadcast_to(v <= 1, periodogram.shape), keepdims=True
    )
    across, down = (jnp.asarray(1 / (1 + f**2), dtype=periodogram.dtype) for f in (u, v))
    return on_v * across + on_u * down
