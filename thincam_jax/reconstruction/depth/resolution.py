r"""How finely a zone aperture tells distances apart."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture


def axial_resolution(camera: LenslessCamera, object_distance: Numbers) -> Float[Array, "*distance"]:
    r"""Change of object distance, mm, that takes an object out of focus.

    .. math:: \Delta t = \frac{\pi\, t\,(t+d)}{\beta\, d\, R^2}

    The shadow of an object at t has the curvature β/M², M = 1 + d/t (ERRATA 3.3), over the half
    width MR. Focused at t + Δt, a reconstruction correlates it with another curvature; at the
    shadow's edge the two differ in phase by 2βdR²Δt/(Mt²), which is 2π here. A round aperture's
    image of an axis point then is zero (as a lens' is at its axial resolution), a square one's 9 %
    of that in focus. R is the half width of that part of the mask whose shadow the sensor sees,
    in the mean square over rows and columns.

    Δt/t² is nearly constant: resolvable planes are evenly spaced in 1/t (`refocus_distances`). This
    is for detail as fine as the aperture passes, of the frequency ρ₀ = βR/(πM) on the sensor. A
    zone aperture carries the frequency ρ at the radius πρ/β, so that coarser detail has less
    parallax: (ρ₀/ρ)² times the depth of focus. An even surface has no distance.

    **Arguments**: `object_distance` t, mm, one or an array of them.

    **Errors**: TypeError for a camera without a Fresnel zone aperture.
    """
    mask = camera.mask
    if not isinstance(mask, FresnelZoneAperture):
        raise TypeError(
            f"axial_resolution knows the curvature of a FresnelZoneAperture only; the camera has a "
            f"{type(mask).__name__}"
        )
    t = checks.positive_all("object_distance", jnp.asarray(object_distance), "mm")
    d = camera.distance
    t = t.astype(d.dtype)
    magnification = 1 + d / t
    sides = [n * camera.sensor.pitch / (2 * magnification) for n in camera.sensor.shape]
    halves = zip(mask.extent, sides, strict=True)
    squared = sum(jnp.minimum(across / 2, side) ** 2 for across, side in halves) / 2
    return jnp.pi * t * (t + d) / (mask.beta * d * squared)


def refocus_distances(nearest: Number, farthest: Number, count: int) -> Float[Array, " count"]:
    """`count` distances from `nearest` to `farthest`, mm, evenly spaced in 1/t.

    Defocus is linear in 1/t, so that every step changes the sharpness alike.
    """
    near = checks.positive("nearest", nearest, "mm")
    far = checks.positive("farthest", farthest, "mm")
    if count < 2:
        raise ValueError(f"count = {count}; give at least 2 distances")
    if not checks.is_traced(near) and not checks.is_traced(far) and not near < far:
        raise ValueError(f"nearest = {near} mm is not below farthest = {far} mm; swap them")
    return 1 / jnp.linspace(1 / near, 1 / far, count)
