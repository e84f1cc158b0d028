r"""Sums and differences of captures that are reconstructed in place of the captures.

A synthesis is a real matrix W (channel × capture): the channel c is Σ_k W_ck g_k, and its response
Σ_k W_ck H_k. The fringe-scanned response of the thesis is complex; its real and imaginary parts are
two real channels here, so that results are real without a projection and noise is counted right.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array

from thincam_jax._core.checks import Numbers, is_traced
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction.imaging_model import register


def separate(count: int) -> np.ndarray:
    """Every capture a channel of its own: one capture, or colour channels."""
    return np.eye(count)


def fringe_scanning(groups: int) -> np.ndarray:
    """Captures in groups of four phases 0, π/2, π, 3π/2 (thesis Eq 3.14, 3.31, corrected).

    For each group the channels H(3π/2) − H(π/2) and H(0) − H(π), which are (π/β)cos X and
    (π/β)sin X times the diffraction term, X = π²ρ²/β: constant and second harmonic cancel.
    """
    return harmonics(groups, 4, (1,))


def harmonics(groups: int, steps: int, orders: Sequence[int]) -> np.ndarray:
    r"""Captures in groups of K phases 2πq/K: harmonics m of each group over the phase.

    For each group and m the channels Σ_q −sin(mφ_q) H_q and Σ_q cos(mφ_q) H_q, the real and
    imaginary part of jΣ H_q e^{jmφ_q} = jK H_{-m}, into which m ± K are folded (see
    `thincam_jax.lensless.phase_shift.harmonic_otf`). Constant and all other harmonics cancel.
    ValueError unless 0 < m < K/2: K phases cannot distinguish others.
    """
    if not orders or not all(0 < 2 * m < steps for m in orders):
        raise ValueError(
            f"harmonics {list(orders)} of {steps} phases; give some from 1 to {(steps - 1) // 2}, "
            "or more phases"
        )
    angles = 2 * np.pi * np.outer(orders, np.arange(steps)) / steps
    rows = np.stack([-np.sin(angles), np.cos(angles)], axis=1).reshape(-1, steps)
    # Exact zeros: a capture with one is not used.
    return np.kron(np.eye(groups), np.where(np.abs(rows) < 1e-12, 0.0, rows))


def phase_pairs(groups: int) -> np.ndarray:
    """Captures in pairs of phases 0, 3π/2: H(0) − H(3π/2) of each (thesis Eq 3.49, corrected).

    The constant cancels; the second harmonic, and with it twice the aperture's cut-off, stays.
    """
    return np.kron(np.eye(groups), np.array([[1.0, -1.0]]))


def contrasts(count: int) -> np.ndarray:
    """The information in captures without their common background: count − 1 orthonormal sums.

    Masks of one width at one distance cast the same background, whatever their β and phase: it
    cancels where the weights of a row add up to zero. Pairs of two β leave one such sum unused,
    (g₁ + g₂) − (g₃ + g₄), whose fringes are as strong. Rows are those of Helmert's matrix; for
    captures of equal noise any other orthonormal rows are equivalent.
    """
    if count < 2:
        raise ValueError(f"contrasts of {count} captures; give at least 2")
    return scipy.linalg.helmert(count)


def phase_contrasts(cameras: Sequence[LenslessCamera], wavelength: Any) -> np.ndarray:
    """`contrasts` of each group of captures that differ in the phase of their zone aperture only.

    The others, and those whose phases are equal or traced, stay channels of their own.
    """
    wavelengths = [wavelength] * len(cameras) if np.ndim(wavelength) == 0 else wavelength
    groups: dict[Any, list[int]] = {}
    turns = np.ones(len(cameras), complex)
    for number, (camera, light) in enumerate(zip(cameras, wavelengths, strict=True)):
        mask, key = camera.mask, (number,)
        if isinstance(mask, FresnelZoneAperture) and not is_traced(mask.phase):
            alike = eqx.tree_at(lambda m: m.phase, mask, 0.0), camera.sensor, camera.distance, light
            turns[number] = np.exp(1j * float(mask.phase))
            leaves, structure = jax.tree.flatten(alike)
            key = structure, *(id(n) if is_traced(n) else np.asarray(n).tobytes() for n in leaves)
        groups.setdefault(key, []).append(number)
    rows = []
    for group in groups.values():
        differ = np.abs(turns[group] - turns[group[0]]).max() > 1e-6
        rows.append((contrasts if differ else separate)(len(group)) @ np.eye(len(cameras))[group])
    return np.concatenate(rows)


def keep_bias(synthesis: np.ndarray) -> np.ndarray:
    """Mask of the channels that keep the captures' common background: weights do not cancel."""
    return np.abs(synthesis.sum(axis=1)) > 1e-6


def synthesis_matrix(
    given: Numbers | Sequence[Sequence[float]] | None,
    cameras: Sequence[LenslessCamera],
    ratios: Sequence[float],
) -> np.ndarray:
    """The synthesis given, checked against the cameras; by default each capture is a channel.

    **Errors**: ValueError where a channel adds captures of different scales, or two share noise.
    """
    synthesis = separate(len(cameras)) if given is None else np.asarray(given, dtype=float)
    if synthesis.ndim != 2 or synthesis.shape[1] != len(cameras):
        raise ValueError(
            f"synthesis has shape {synthesis.shape}; give (channels, {len(cameras)}), "
            "one column for each camera"
        )
    if not np.any(synthesis, axis=1).all():
        raise ValueError("synthesis has a row of zeros: every channel needs a capture")
    for row in synthesis:
        used = {r for w, r in zip(row, ratios, strict=True) if w}
        if len(used) > 1:
            raise ValueError("a channel combines captures at different distances; make them two")
    gram = synthesis @ synthesis.T
    if np.abs(gram - np.diag(np.diag(gram))).max() > 1e-9 * np.abs(gram).max():
        raise ValueError("channels share noise: make the rows of synthesis orthogonal")
    grids = {(c.sensor.shape, float(c.sensor.pitch)) for c in cameras}
    if len(grids) > 1:
        raise ValueError(f"cameras have different sensors {sorted(grids)}; use one sensor")
    return synthesis


class SynthesisRow:
    """A row of a synthesis: its kernel, its capture and the mask of its valid pixels."""

    def __init__(
        self,
        row: np.ndarray,
        kernels: Sequence[Array],
        captures: Sequence[Array],
        valid: Sequence[Any],
        ratios: Sequence[float],
    ):
        used = _used(row)
        self.ratio = ratios[used[0][1]]
        self.kernel = _weighted_sum(used, kernels)
        self.capture = channel_capture(row, captures, ratios)
        self.valid = None
        if valid[0] is not None or self.ratio > 1:
            both = jnp.ones(captures[0].shape, bool)
            if valid[0] is not None:
                both = jnp.all(jnp.stack([valid[k] for _, k in used]), axis=0)
            # A pixel interpolated from an invalid one, or from beyond the sensor, is invalid, too;
            # the interpolation also overshoots.
            seen = register(both.astype(captures[0].dtype), self.ratio)
            self.valid = with_channel(jnp.abs(seen - 1) < 0.01, 2)


def channel_capture(
    row: Sequence[float] | np.ndarray, captures: Sequence[Array], ratios: Sequence[float]
) -> Array:
    """The sum of captures of a synthesis' row, enlarged to its scale, with a channel axis."""
    used = _used(row)
    return with_channel(register(_weighted_sum(used, captures), ratios[used[0][1]]), 2)


def _used(row) -> list[tuple[float, int]]:
    return [(float(w), k) for k, w in enumerate(row) if w]


def _weighted_sum(used: Sequence[tuple[float, int]], parts: Sequence[Array]) -> Array:
    # A factor of 1 would be one more copy, and one more program.
    scaled = [parts[k] if w == 1 else w * parts[k] for w, k in used]
    return functools.reduce(operator.add, scaled)


def with_channel(capture: Array, axes: int) -> Array:
    """A capture with a channel axis before its own axes."""
    return capture[None] if capture.ndim == axes else capture
