"""Reconstructions of one set of captures over a list of object distances."""

from collections.abc import Callable, Sequence
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import Model
from thincam_jax.reconstruction import TotalVariation, reconstruct
from thincam_jax.reconstruction.arguments import FILTERS, Method
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.spectra import Prior

_LEAST = 3  # a maximum inside of the sweep needs two neighbours


class RefocusSweep(eqx.Module):
    """Images of one scene, each focused on another distance, all on one grid of directions.

    Pixel (i, j) of every image looks along the same ray through the middle of the mask: a point at
    (x, y, t) is projected on −(d/t)(x, y) whatever the focus, so that the tangent of the angle
    between neighbouring pixels is `slope` = p/d (of the largest d) in all images. In millimetres on
    the object their pitch is p·t/d and grows with the distance.

    - `images`: radiance, (distance, *batch, y, x), upright.
    - `distances`: t, mm, increasing.
    - `slope`: p/d.
    """

    images: Float[Array, "distance *batch y x"]
    distances: Float[Array, " distance"]
    slope: Float[Array, ""]
    method: str = eqx.field(static=True, default="")

    @property
    def pitch(self) -> Float[Array, " distance"]:
        """Distance of the pixels on the object, mm, of each image."""
        return self.slope * self.distances


def refocus_sweep(
    captures: Float[Array, "capture *batch y x"] | Sequence[Float[Array, "*batch y x"]],
    cameras: Sequence[LenslessCamera],
    distances,
    *,
    method: Method = "wiener",
    wavelength=None,
    noise_variance=None,
    synthesis=None,
    field_shape: tuple[int, int] | None = None,
    prior: Prior = "inverse_square",
    tau=None,
    variation: TotalVariation | None = None,
    iterations: int | None = None,
    tolerance: float | None = None,
    model: Model = "separable",
    pixel_integration: bool = True,
    callback: Callable[[int], object] | None = None,
) -> RefocusSweep:
    """One reconstruction after the other, focused on each of `distances`.

    Each is a whole image of the scene as if all of it stood there: what does stands out sharp, the
    rest is blurred. Planes are not separated; for that, give `thincam_jax.reconstruct` several
    distances at once with admm_tv.

    Nothing is compiled twice: a distance is an argument of every method's compiled programs, and
    all images but the first cost their arithmetic only.

    **Arguments**

    - `distances`: mm, at least three, increasing; best evenly spaced in 1/t (`refocus_distances`),
      with a step below a third of `axial_resolution`.
    - `callback`: called with the number of images done after each.
    - all others: as in `thincam_jax.reconstruct`.

    **Errors**: ValueError, one line, for distances that are not positive and increasing.
    """
    focus = _increasing(distances)
    if isinstance(tau, str):
        raise ValueError(
            f"tau = {tau!r} would be another number at each distance, whose images then do not "
            "compare; give a number"
        )
    if noise_variance is None and method != "poisson":
        noise_variance = estimate_variance(jnp.asarray(captures))
    images, pitch = [], None
    for index, distance in enumerate(focus):
        result = reconstruct(
            captures,
            cameras,
            method=method,
            object_distance=distance,
            wavelength=wavelength,
            noise_variance=noise_variance,
            synthesis=synthesis,
            field_shape=field_shape,
            prior=prior,
            tau=tau,
            variation=variation,
            iterations=iterations,
            tolerance=tolerance,
            model=model,
            pixel_integration=pixel_integration,
        )
        images.append(result.image)
        pitch = result.pitch
        if method == "auto":  # chooses once: images of two methods do not compare
            method = cast(Method, result.method)
            if method in FILTERS:  # they refuse what the choice has left aside
                tau = variation = iterations = tolerance = None
        if callback is not None:
            callback(index + 1)
    stack = jnp.stack(images)
    # p·t/d of the last image over its t.
    slope = jnp.reshape(jnp.asarray(pitch, stack.dtype), ()) / jnp.asarray(focus[-1], stack.dtype)
    return RefocusSweep(stack, jnp.asarray(focus, stack.dtype), slope, method)


def _increasing(distances) -> list[float]:
    values = np.asarray(distances, dtype=float)
    if values.ndim != 1 or values.size < _LEAST:
        raise ValueError(
            f"distances has shape {values.shape}; give a list of at least {_LEAST} distances in mm"
        )
    if not (np.isfinite(values).all() and values[0] > 0 and (np.diff(values) > 0).all()):
        raise ValueError(
            f"distances = {values.tolist()} mm; give finite positive distances, increasing"
        )
    return values.tolist()
