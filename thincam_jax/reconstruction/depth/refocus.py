"""Reconstructions of one set of captures over a list of object distances."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.checks import Numbers
from thincam_jax.reconstruction.methods import choose_solver, reconstruct
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.poisson import PoissonTV
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.seen_by import Cameras, Psfs
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
    - `slope`: p/d; None over measured PSFs, which do not tell it.
    """

    images: Float[Array, "distance *batch y x"]
    distances: Float[Array, " distance"]
    slope: Float[Array, ""] | None
    method: str = eqx.field(static=True, default="")

    @property
    def pitch(self) -> Float[Array, " distance"] | None:
        """Distance of the pixels on the object, mm, of each image; None over measured PSFs."""
        return None if self.slope is None else self.slope * self.distances


def refocus_sweep(
    recording: Recording,
    distances: Numbers | Sequence[float | int],
    solver: AbstractSolver | None = None,
    *,
    callback: Callable[[int], object] | None = None,
) -> RefocusSweep:
    """One reconstruction after the other, focused on each of `distances`.

    Each is a whole image of the scene as if all of it stood there: what does stands out sharp, the
    rest is blurred. Planes are not separated; for that, give `Cameras` several distances at once
    and use `AdmmTV`.

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
    focused = _focused(recording, focus)
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
    """The recording focused on each distance: another PSF, all else as it is."""
    seen_by = recording.seen_by
    if isinstance(seen_by, Cameras):
        return [recording.focused(distance) for distance in distances]
    if not isinstance(seen_by, Psfs):
        raise ValueError("a sweep refocuses PSFs; give a recording seen by Cameras or Psfs")
    planes = seen_by.psfs.shape[2]
    if planes != len(distances):
        raise ValueError(
            f"the PSFs have {planes} planes, (capture, channel, plane, k, l), for "
            f"{len(distances)} distances; give one for each"
        )
    stacks = [seen_by.psfs[:, :, k : k + 1] for k in range(planes)]
    return [replace(recording, seen_by=replace(seen_by, psfs=stack)) for stack in stacks]


def increasing(distances: Numbers | Sequence[float | int]) -> list[float]:
    """The distances of a sweep, mm, checked: ValueError as of `refocus_sweep`."""
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
