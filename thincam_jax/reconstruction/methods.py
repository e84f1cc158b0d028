"""`reconstruct`, the solvers by their names, and which of them suits a recording."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.drive import Callback
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.poisson import PoissonTV
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.registration import distance_ratios
from thincam_jax.reconstruction.regularised import AdmmTV, Fista
from thincam_jax.reconstruction.ridge import Ridge
from thincam_jax.reconstruction.seen_by import Cameras, Psfs
from thincam_jax.reconstruction.solver import (
    AbstractIterativeSolver,
    AbstractSolver,
    Reconstruction,
    Synthesis,
)
from thincam_jax.reconstruction.synthesis import check_synthesis, keep_bias, separate
from thincam_jax.reconstruction.wiener import Wiener

# The words of experiment files and commands, `method: admm_tv`.
SOLVERS: dict[str, type[AbstractSolver]] = {
    solver.name: solver for solver in (Wiener, FringeScanning, AdmmTV, Fista, Ridge, PoissonTV)
}

# Contrast of a channel over its noise from which a filter is trusted. A judgement: total variation
# gains 0.5 to 2.5 dB at 1 to 3 (configs/fza_admm_tv.yaml), and next to nothing without noise.
_CLEAN = 30.0


def reconstruct(
    recording: Recording,
    solver: AbstractSolver | None = None,
    *,
    start: Float[Array, "..."] | None = None,
    callback: Callback | None = None,
) -> Reconstruction:
    """The image of a scene from captures of it.

    **Arguments**

    - `recording`: what was seen, see `Recording`.
    - `solver`: what is done about it: `Wiener`, `FringeScanning` (filters, for `Cameras`),
      `AdmmTV`, `Fista`, `Ridge` or `PoissonTV`. Default: the one of `choose_solver`, whose reason
      the result tells.
    - `start`: a first image, such as an earlier result. By default it is uniform with cameras and
      for `PoissonTV`, else black. Where it is given `AdmmTV` has no first part without the
      uniform light, see docs/reconstruction.md.
    - `callback`: called with `Progress` every tenth iteration of `AdmmTV` and `Fista`; a true
      answer stops the run. Ctrl-C returns the best image so far, with status "interrupted".

    Images of a batch are reconstructed together. To reconstruct many recordings by a filter call
    its `prepare` once. Under jit, grad or vmap use `solve_fixed_point`.

    **Errors**: ValueError and TypeError, one line, for captures that do not fit what has seen
    them, and for a start or callback of a solver that runs in one piece.
    """
    if not isinstance(recording, Recording):
        raise TypeError(
            f"recording is a {type(recording).__name__}; give tc.Recording(captures, "
            "tc.Cameras(…)), or tc.Psfs(…) or operators in their place"
        )
    reason = ""
    if solver is None:
        solver, reason = choose_solver(recording)
    if isinstance(solver, AbstractIterativeSolver):
        if any(checks.is_traced(capture) for capture in recording.captures):
            raise TypeError(
                f"{type(solver).__name__} looks at its numbers between the iterations: call it "
                "outside of jit, grad and vmap, or use tc.solve_fixed_point there"
            )
        result = solver.solve(recording, start=start, callback=callback)
    elif not isinstance(solver, AbstractSolver):
        raise TypeError(f"solver is {solver!r}; give a solver, such as tc.AdmmTV(tau=2.0)")
    elif start is not None or callback is not None:
        raise ValueError(f"{type(solver).__name__} runs in one piece; leave out start and callback")
    else:
        result = solver.solve(recording)
    return dataclasses.replace(result, reason=reason) if reason else result


def choose_solver(
    recording: Recording, synthesis: Synthesis | None = None
) -> tuple[AbstractSolver, str]:
    """`Wiener` or `AdmmTV`, and a sentence that says why.

    What decides is what the fast filter cannot do: see the crop of the sensor, which matters where
    the captures keep a bright background or a PSF is as large as the sensor, and tell noise from
    edges.

    - `synthesis`: sums of captures that the solver is to take; see `AdmmTV`.
    """
    method, reason = _choice(recording, synthesis)
    return (Wiener if method == "wiener" else AdmmTV)(synthesis=synthesis), reason


def _choice(recording: Recording, synthesis) -> tuple[str, str]:
    seen_by = recording.seen_by
    if not isinstance(seen_by, Cameras):
        if isinstance(seen_by, Psfs):
            return "admm_tv", "PSFs were measured: light falls beside the sensor, which it models"
        return "admm_tv", "operators were given, and a filter is made of cameras"
    if recording.valid is not None:
        return "admm_tv", "some pixels are not to be trusted, which a filter cannot leave out"
    if np.ndim(seen_by.object_distance) > 0:
        return "admm_tv", "several planes are asked for, which a filter does not tell apart"
    cameras, noise_variance = seen_by.cameras, recording.noise_variance
    captures = jnp.stack(recording.captures)
    matrix = separate(len(cameras)) if synthesis is None else np.asarray(synthesis, dtype=float)
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
