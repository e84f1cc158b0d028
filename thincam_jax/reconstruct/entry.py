"""`reconstruct`: the one entry point."""

from collections.abc import Sequence
from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax import _checks
from thincam_jax.camera import LenslessCamera
from thincam_jax.psf import Model
from thincam_jax.reconstruct.fringe_scanning import FringeScanning
from thincam_jax.reconstruct.result import Reconstruction
from thincam_jax.reconstruct.spectra import Prior
from thincam_jax.reconstruct.synthesis import separate
from thincam_jax.reconstruct.wiener import WienerSynthesis

Method = Literal["wiener", "fringe_scanning"]
METHODS: tuple[Method, ...] = get_args(Method)


def reconstruct(
    captures: Float[Array, "capture *batch y x"] | Sequence[Float[Array, "*batch y x"]],
    cameras: Sequence[LenslessCamera],
    *,
    method: Method = "wiener",
    object_distance,
    wavelength=None,
    noise_variance=None,
    synthesis=None,
    field_shape: tuple[int, int] | None = None,
    prior: Prior = "inverse_square",
    model: Model = "separable",
    pixel_integration: bool = True,
) -> Reconstruction:
    """The image of a flat scene from captures of it.

    **Arguments**

    - `captures`: (capture, *batch, y, x), one for each camera.
    - `cameras`: what took them.
    - `method`: "wiener" (see `WienerSynthesis`, which needs `wavelength` and `noise_variance`; the
      default `synthesis` takes every capture by itself) or "fringe_scanning" (see
      `FringeScanning`, which uses neither).
    - `object_distance`: t, mm, on which to focus.
    - the others: see `WienerSynthesis`.

    To reconstruct many scenes with the same cameras build `WienerSynthesis` or `FringeScanning`
    once and call it: the filter is then computed once.

    **Errors**: ValueError, one line, for captures that do not fit the cameras and for unknown
    methods, models and priors.
    """
    _checks.choice("method", method, METHODS)
    captures = jnp.asarray(captures)
    if captures.ndim < 3 or captures.shape[0] != len(cameras):
        raise ValueError(
            f"captures have shape {captures.shape} for {len(cameras)} cameras; give "
            f"({len(cameras)}, …, y, x)"
        )
    if method == "fringe_scanning":
        scanning = FringeScanning(cameras, object_distance=object_distance, field_shape=field_shape)
        return scanning(captures)
    if wavelength is None or noise_variance is None:
        raise ValueError("method 'wiener' needs wavelength (mm) and noise_variance (units²)")
    filtering = WienerSynthesis(
        cameras,
        wavelength=wavelength,
        object_distance=object_distance,
        synthesis=separate(len(cameras)) if synthesis is None else synthesis,
        field_shape=field_shape,
        prior=prior,
        model=model,
        pixel_integration=pixel_integration,
    )
    return filtering(captures, noise_variance)
