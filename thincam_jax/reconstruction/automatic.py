"""Which method suits a set of captures, and why."""

from collections.abc import Sequence
from typing import TypeGuard

import jax.numpy as jnp
import numpy as np

from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.registration import distance_ratios
from thincam_jax.reconstruction.synthesis import check_synthesis, keep_bias

# Contrast of a channel over its noise from which a filter is trusted. A judgement: total variation
# gains 0.5 to 2.5 dB at 1 to 3 (configs/fza_admm_tv.yaml), and next to nothing without noise.
_CLEAN = 30.0

# The methods that may be chosen.
CANDIDATES = ("wiener", "admm_tv")


def choose_method(
    captures, cameras, synthesis, noise_variance, *, valid=None, object_distance=None
) -> tuple[str, str]:
    """A method and a sentence that says why.

    What decides is what the fast filter cannot do: see the crop of the sensor, which matters where
    the captures keep a bright background or a PSF is as large as the sensor, and tell noise from
    edges.
    """
    if not are_cameras(cameras):
        return "admm_tv", "PSFs were measured: light falls beside the sensor, which it models"
    if valid is not None:
        return "admm_tv", "some pixels are not to be trusted, which a filter cannot leave out"
    if object_distance is not None and np.ndim(object_distance) > 0:
        return "admm_tv", "several planes are asked for, which a filter does not tell apart"
    matrix = np.eye(len(cameras)) if synthesis is None else np.asarray(synthesis, dtype=float)
    check_synthesis(matrix, cameras, distance_ratios(cameras))
    biased = keep_bias(matrix)
    biased |= np.array([_backgrounds_differ(row, cameras) for row in matrix])
    if biased.any():
        return "admm_tv", (
            f"{int(biased.sum())} of {len(matrix)} channels keep the bright background of their "
            "captures, which the sensor crops; a filter would ring at its borders"
        )
    contrast = _contrast(captures, matrix, noise_variance)
    if not contrast >= _CLEAN:
        return "admm_tv", (
            f"the channels' contrast is {contrast:.2g} times their noise; total variation tells "
            "edges from noise where a filter cannot"
        )
    return "wiener", (
        f"no channel keeps a background and their contrast is {contrast:.2g} times the noise: the "
        "Wiener synthesis is as good, in closed form"
    )


def _backgrounds_differ(row: np.ndarray, cameras: Sequence[LenslessCamera]) -> bool:
    """Apertures of unlike widths let unlike light through, which no difference takes away."""
    used = [camera.mask for weight, camera in zip(row, cameras, strict=True) if weight]
    return len({float(getattr(mask, "width", 0)) for mask in used}) > 1


def are_cameras(cameras) -> TypeGuard[Sequence[LenslessCamera]]:
    """Whether these are camera models, and not an array of measured PSFs."""
    return isinstance(cameras, Sequence) and all(isinstance(c, LenslessCamera) for c in cameras)


def _contrast(captures, matrix: np.ndarray, noise_variance) -> float:
    """Root mean square of the channels over their noise, of the clearest one."""
    flat = captures.reshape(captures.shape[0], -1, *captures.shape[-2:])
    if noise_variance is None:
        variances = estimate_variance(flat)
    else:
        variances = given_variances(noise_variance, flat)
    ratios = []
    for row in matrix:
        channel = jnp.tensordot(jnp.asarray(row, flat.dtype), flat, axes=1)
        noise = jnp.sum(jnp.asarray(row**2, flat.dtype) * variances)
        power = jnp.maximum(jnp.mean(channel**2) - noise, 0)
        ratios.append(float(jnp.sqrt(power / noise)) if noise > 0 else float("inf"))
    return max(ratios)
