"""Reconstructions of one set of captures over object distances, and how finely these resolve."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.progress import watched
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs
from thincam_jax.reconstruction.methods import choose_solver, reconstruct
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.outside_light import pinned
from thincam_jax.reconstruction.poisson import PoissonTV
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.solver import AbstractSolver

_LEAST = 3  # a maximum inside of the sweep needs two neighbours


class RefocusSweep(eqx.Module):
    """Images of one scene, each focused on another distance, all on one grid of directions.

    Pixel (i, j) of every image looks along the same ray through the middle of the mask: a point at
    (x, y, t) is projected on −(d/t)(x, y) whatever the focus, so that the tangent of the angle
    between neighbouring pixels is `slope` = p/d (of the largest d) in all images. In millimetres on
    the object their pitch is p·t/d and grows with the distance.

    - `images`: radiance, (distance, *batch, y, x), upright.
    - `distances`: t, mm, increasing.
    - `slope`: p/d; None with measured PSFs.
    """

    images: Float[Array, "distance *batch y x"]
    distances: Float[Array, " distance"]
    slope: Float[Array, ""] | None
    method: str = eqx.field(static=True, default="")

    @property
    def pitch(self) -> Float[Array, " distance"] | None:
        """Distance of the pixels on the object, mm, of each image; None with measured PSFs."""
        return None if self.slope is None else self.slope * self.distances


@checked
@watched("refocusing")
def refocus_sweep(
    recording: Recording,
    distances: Numbers | Sequence[float | int],
    solver: AbstractSolver | None = None,
    *,
    callback: Callable[[int], object] | None = None,
) -> RefocusSweep:
    """Reconstructions focused on each of several distances.

    Each is an image of the whole scene as if it were at that distance: objects at the distance are
    sharp, all others blurred. To separate planes give `Cameras` several distances at once and use
    `AdmmTV`.

    Nothing is compiled twice: a distance is an argument of every method's compiled programs, and
    all images but the first cost their arithmetic only.

    **Arguments**

    - `recording`: seen by `Cameras`, whose own object distance is not used; or by `Psfs` with a
      plane for each of `distances`, measured there with a point on the axis.
    - `distances`: mm, at least three, increasing; best evenly spaced in 1/t (`refocus_distances`),
      with a step below a third of `axial_resolution`.
    - `solver`: default the one of `choose_solver`, chosen once: images of two methods do not
      compare.
    - `callback`: called with the number of images done after each.

    **Errors**: ValueError, one line, for distances that are not positive and increasing.
    """
    focus = increasing(distances)
    tau = getattr(solver, "tau", None)
    if isinstance(tau, str):
        raise ValueError(
            f"tau = {tau!r} would be another number at each distance, whose images then do not "
            "compare; give a number"
        )
    if recording.noise_variance is None and not isinstance(solver, PoissonTV):
        recording = recording.with_noise(estimate_variance(recording.captures))
    focused = [pinned(one) for one in _focused(recording, focus)]
    if solver is None:
        solver, _ = choose_solver(focused[0])
    images, slope = [], None
    for index, (one, distance) in enumerate(zip(focused, focus, strict=True)):
        result = reconstruct(one, solver)
        images.append(result.image)
        if result.pitch is not None:
            slope = jnp.reshape(jnp.asarray(result.pitch), ()) / distance  # p·t/d over t
        if callback is not None:
            callback(index + 1)
    stack = jnp.stack(images)
    slope = None if slope is None else jnp.asarray(slope, stack.dtype)
    return RefocusSweep(stack, jnp.asarray(focus, stack.dtype), slope, solver.name)


def _focused(recording: Recording, distances: list[float]) -> list[Recording]:
    """The recording with the PSF of each distance."""
    model = recording.imaging_model
    if isinstance(model, Cameras):
        return [recording.focused(distance) for distance in distances]
    if not isinstance(model, Psfs):
        raise ValueError("a sweep refocuses PSFs; give a recording seen by Cameras or Psfs")
    planes = model.psfs.shape[2]
    if planes != len(distances):
        raise ValueError(
            f"the PSFs have {planes} planes, (capture, channel, plane, k, l), for "
            f"{len(distances)} distances; give one for each"
        )
    stacks = [model.psfs[:, :, k : k + 1] for k in range(planes)]
    return [replace(recording, imaging_model=replace(model, psfs=s)) for s in stacks]


def increasing(distances: Numbers | Sequence[float | int]) -> list[float]:
    """The distances of a sweep, mm, checked: ValueError as of `refocus_sweep`."""
    values = checks.numbers("distances", distances).astype(float)
    if values.ndim != 1 or values.size < _LEAST:
        raise ValueError(
            f"distances has shape {values.shape}; give a list of at least {_LEAST} distances in mm"
        )
    if not (np.isfinite(values).all() and values[0] > 0 and (np.diff(values) > 0).all()):
        raise ValueError(
            f"distances = {values.tolist()} mm; give finite positive distances, increasing"
        )
    return values.tolist()


@checked
def axial_resolution(
    camera: LenslessCamera, *, object_distance: Numbers
) -> Float[Array, "*distance"]:
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
    parallax: (ρ₀/ρ)² times the depth of focus. A uniform surface has no distance.

    **Arguments**: `object_distance` t, mm, one or an array of them.

    **Errors**: TypeError for a camera without a Fresnel zone aperture.
    """
    mask = camera.mask
    if not isinstance(mask, FresnelZoneAperture):
        raise TypeError(
            f"axial_resolution knows the curvature of a FresnelZoneAperture only; the camera has a "
            f"{type(mask).__name__}"
        )
    t = checks.positive_all("object_distance", object_distance, "mm")
    d = camera.distance
    t = t.astype(d.dtype)
    magnification = 1 + d / t
    sides = [n * camera.sensor.pitch / (2 * magnification) for n in camera.sensor.shape]
    halves = zip(mask.extent, sides, strict=True)
    squared = sum(jnp.minimum(across / 2, side) ** 2 for across, side in halves) / 2
    return jnp.pi * t * (t + d) / (mask.beta * d * squared)


@checked
def refocus_distances(nearest: Number, farthest: Number, count: int) -> Float[Array, " count"]:
    """`count` distances from `nearest` to `farthest`, mm, evenly spaced in 1/t.

    Defocus is linear in 1/t, so that every step changes the sharpness equally.
    """
    near = checks.positive("nearest", nearest, "mm")
    far = checks.positive("farthest", farthest, "mm")
    if count < 2:
        raise ValueError(f"count = {count}; give at least 2 distances")
    if not checks.is_traced(near) and not checks.is_traced(far) and not near < far:
        raise ValueError(f"nearest = {near} mm is not below farthest = {far} mm; swap them")
    return 1 / jnp.linspace(1 / near, 1 / far, count)
