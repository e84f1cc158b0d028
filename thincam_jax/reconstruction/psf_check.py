r"""Check a measured PSF against a capture: other scales, rotations and mirror images."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.grids import block_mean, block_sum
from thincam_jax._core.progress import watched
from thincam_jax.reconstruction.coarse import coarser
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.problem import InverseProblem, forward, objective, residuals
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.solver import first_image
from thincam_jax.reconstruction.splittings import admm_method

Orientation = Literal[
    "as given",
    "turned by 90°",
    "turned by 180°",
    "turned by 270°",
    "mirrored left to right",
    "mirrored left to right, then turned by 90°",
    "mirrored top to bottom",
    "mirrored left to right, then turned by 270°",
]
ORIENTATIONS: tuple[Orientation, ...] = Orientation.__args__  # type: ignore[attr-defined]

_ITERATIONS = 70  # after 50 a background to find leaves objectives up to 10 % above the lowest
_BLOCKS = 8  # along the longer side; the misfit of different blocks is independent
_RINGS = 32  # of spatial frequency, per cycle/pixel
# Of the change of sharpness by a scale that is taken back. Without, wrong PSFs win by being sharper
# (scales 0.2 to 0.7 % off over random cameras); all of it errs as far to the other side.
_SHARE = 0.5
# Standard error at the least, of the change of scale at which the PSF's detail is another's.
_LEAST_ERROR = 0.007
_SIGNIFICANCE = 3.0  # standard errors
_TOLD = 0.01  # width of an interval of scales up to which a PSF is called the best
_LEAST_GAIN = 0.02  # of the objective, for another orientation
_KEPT = 0.8  # of a PSF's variance, by blocks that are fine enough


@dataclass(frozen=True)
class PsfCheck:
    """Result of `check_psf`.

    - `orientation`: orientation of the best fit relative to the PSF given; turns are anticlockwise.
    - `scale`: size of the PSF that fits best over that of the one given; `scale_error`: its
      standard error.
    - `scales`, `objectives`: the profile: scales tried in the best orientation, and the lowest
      objective at each, relative to the lowest of all.
    - `noise_ratio`: rms of the residual of the best PSF over the noise; near 1 it explains all.
    - `reasons`: one line for each fault; empty if the PSF fits as given.
    """

    orientation: Orientation
    scale: float
    scale_error: float
    scales: tuple[float, ...]
    objectives: tuple[float, ...]
    noise_ratio: float
    reasons: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether no other scale or orientation fits better."""
        return not self.reasons

    @property
    def interval(self) -> tuple[float, float]:
        """The scales that fit, with a probability of 95 %: two standard errors to either side."""
        return self.scale - 2 * self.scale_error, self.scale + 2 * self.scale_error

    def __str__(self) -> str:
        """Residual and scale, and a line for each fault."""
        scale = f"best scale {self.scale:.4f} ± {self.scale_error:.4f}"
        faults = [f"your PSF is wrong: {reason}" for reason in self.reasons]
        first = f"residual {self.noise_ratio:.2f} times the noise, {scale}"
        low, high = min(1.0, self.interval[0]), max(1.0, self.interval[1])
        fits = "your PSF fits best as it is"
        if high - low > _TOLD:
            fits = f"your PSF fits; {low:.3f} to {high:.3f} times its size cannot be told apart"
        return "\n".join([first, *(faults or [fits])])


@dataclass(frozen=True, eq=False)
class _Tried:
    """A PSF tried: the lowest objective, ½ w r² summed over blocks of pixels, and the image."""

    objective: float
    misfits: np.ndarray
    image: Image


def searched(
    recording: Recording, search: float | int, most: float
) -> tuple[tuple[int, int], float]:
    """Shape of the captures and how far to search. **Errors**: ValueError, too small or wide."""
    rows, columns = recording.captures[0].shape[-2:]
    if min(rows, columns) < 32:
        raise ValueError(f"captures have {(rows, columns)} pixels; give at least 32 a side")
    search = float(checks.positive("search", search, "parts of one"))
    if search > most:
        raise ValueError(f"search = {search:g} is too wide; give at most {most:g}")
    return (rows, columns), search


@checked
@watched("checking the PSF")
def check_psf(
    recording: Recording,
    *,
    search: float | int = 0.06,
    tau: float | int = 2.0,
    callback: Callable[[int, int], object] | None = None,
) -> PsfCheck:
    r"""Detect a PSF of a wrong scale or orientation from the capture itself.

    For each orientation o and scale s of the PSF h the scene is reconstructed, non-negative and
    with total variation R, and the lowest objective is noted:

    .. math:: J(o, s) = \min_{f \ge 0} \tfrac12 \sum w\,(h_{o,s} * f - g)^2 + \tau R(f).

    A wrong PSF explains a capture nearly as well as the right one, by an image full of artefacts:
    the residual alone is 1 to 2 times as large. J includes the artefacts. The eight orientations
    are tried first, then scales of the best one, in steps of a pixel at the edge; s is at the
    minimum of the parabola through them. Its standard error is that of an estimate whose model is
    wrong (White, Econometrica 50, 1, 1982), so that it grows with the misfit found: with b blocks

    .. math:: \sigma_s = \Big(\sum_b (q_b - \bar q)^2\Big)^{1/2} \Big/ J''(s), \qquad
        q_b = \sum_b w\,r\,(\partial_s h_s * f),

    and at least 0.007 of the scale's change that makes the PSF another, ‖h‖/‖∂h/∂s‖. A scale is
    reported wrong if it is off by more than three standard errors, an orientation if the misfits of
    the blocks agree by three standard errors and J falls by 2 %. A symmetric PSF has no wrong
    orientation.

    **Not detected**: a shifted PSF, which shifts the image and fits as well; blur, or a scale
    more than `search` away; and the scale with a quarter turn if the sensor is not square, since
    part of the PSF is then missing. Turn the PSF, then check it again.

    **Arguments**

    - `recording`: captures of at least 32 pixels a side with `Psfs` of one plane. Some 20
      reconstructions are made: average blocks of pixels until the longer side is 100 to 200, or 300
      where these would blur the PSF.
    - `search`: range of the scale about 1, at most 0.5.
    - `tau`: weight of total variation, relative to the noise; see `AdmmTV`.
    - `callback`: called with the number of PSFs tried and their total.

    **Errors**: ValueError, one line, for recordings without measured PSFs, and numbers out of
    range; TypeError inside jit.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc

    psfs = tc.Psfs(np.random.default_rng(0).random((1, 13, 13)) ** 6)
    camera = tc.Recording(np.ones((1, 32, 40)), psfs).problem().operators[0]
    chart = jnp.zeros(camera.in_shape).at[..., 12:20, 16:26].set(1.0)
    check = tc.check_psf(tc.Recording(np.asarray(camera(chart))[None], psfs), search=0.02)
    print(check.orientation)  # as given
    ```

    **See also**: `Psfs`, `fit_psf`.
    """
    if not isinstance(recording.imaging_model, Psfs) or recording.imaging_model.psfs.shape[2] != 1:
        raise ValueError("a check takes measured PSFs of one plane; give a recording with tc.Psfs")
    if checks.is_traced(recording.captures[0]):
        raise TypeError("check_psf searches: call it outside jit and grad")
    shape, search = searched(recording, search, 0.5)
    given = np.asarray(recording.imaging_model.psfs)
    try_psf = _Scenes(recording, float(tau))
    pixel = 2 / max(shape)
    wide = math.ceil(search / pixel)
    steps = [k for k in range(-wide, wide + 1) if k]
    todo = len(ORIENTATIONS) + len(steps) + 2
    done = 0

    def tried(turned, scale: float) -> _Tried:
        nonlocal done
        found = try_psf(scaled_psf(turned, scale))
        done += 1
        if callback is not None:
            callback(done, todo)
        return found

    turned = [_oriented(given, k) for k in range(len(ORIENTATIONS))]
    found = [tried(psf, 1.0) for psf in turned]
    best = _best_orientation(found)
    profile = {1.0: found[best]}
    profile |= {1 + k * pixel: tried(turned[best], 1 + k * pixel) for k in steps}
    lowest = min(profile, key=lambda s: profile[s].objective)
    for scale in (lowest - pixel / 2, lowest + pixel / 2):
        profile[scale] = tried(turned[best], scale)
    lowest = min(profile, key=lambda s: profile[s].objective)
    around = [scaled_psf(turned[best], lowest + k * pixel / 2) for k in (-1, 0, 1)]
    slopes = try_psf.slopes(profile[lowest].image, around, pixel)
    change = np.linalg.norm(around[2] - around[0]) / pixel
    least = _LEAST_ERROR * float(np.linalg.norm(around[1]) / change) if change > 0 else np.inf
    scales = np.array(sorted(profile))
    objectives = np.array([profile[s].objective for s in scales])
    near = np.abs(scales - lowest) < 1.1 * pixel
    scale, curvature = _vertex(scales[near], objectives[near])
    spread = math.sqrt(slopes.size) * float(np.std(slopes))
    error = math.hypot(spread / curvature, least) if curvature > 0 else np.inf
    whole = best % 2 == 0 or shape[0] == shape[1]  # nothing of the PSF was cropped to turn it
    reasons = [f"it fits better {ORIENTATIONS[best]}"] if best else []
    if lowest in (scales[0], scales[-1]) and whole:
        reasons.append(f"it fits better at {scale:.4f} times its size, or beyond: search farther")
    elif whole and abs(scale - 1) > _SIGNIFICANCE * error:
        reasons.append(f"it fits better at {scale:.4f} ± {error:.4f} times its size")
    return PsfCheck(
        ORIENTATIONS[best],
        scale,
        error,
        tuple(scales.tolist()),
        tuple((objectives / objectives.min()).tolist()),
        math.sqrt(2 * profile[lowest].misfits.sum() / try_psf.pixels),
        tuple(reasons),
    )


def blocks_blur(psf: Float[np.ndarray, "*batch k l"], block: int, least: float = _KEPT) -> bool:
    """Whether blocks of twice that side keep less than a part of what these do of the variance.

    Below 0.8 scales found by `check_psf` are up to four times less accurate than with all detail.
    """
    rows, columns = (n // (2 * block) * 2 * block for n in psf.shape[-2:])
    kept = block_mean(psf[..., :rows, :columns], block)
    return bool(np.var(block_mean(kept, 2)) < least * np.var(kept))


def on_blocks(problem: InverseProblem, size: int) -> InverseProblem | None:
    """The problem on larger pixels; None where `coarser` has none."""
    blank = jnp.zeros(problem.image_shape, problem.captures[0].dtype)
    found = coarser(problem, blank, size)
    return None if found is None else found[0]


class Trials:
    """Problems of other imaging models, with the weights and the unit of τ of the one given.

    - `size`: side of the blocks of pixels that are averaged; 1, or one that `coarser` takes.
    """

    def __init__(self, recording: Recording, tau: float, size: int = 1):
        self.recording, self.tau, self.size = recording, tau, size
        given = recording.problem(tau=tau)
        self.weights, self.tau_unit = given.weights, given.tau_unit
        coarse = self._coarse(given)
        self.captures = coarse.captures
        pairs = zip(coarse.weights, self.captures, strict=True)
        self.pixels = sum(int(np.count_nonzero(np.broadcast_to(w, c.shape))) for w, c in pairs)
        self.block = max(4, max(self.captures[0].shape[-2:]) // _BLOCKS)

    def problem(self, model: Psfs | Cameras) -> InverseProblem:
        """The problem of another imaging model."""
        problem = replace(self.recording, imaging_model=model).problem(tau=self.tau)
        known = self.weights, self.tau_unit
        return self._coarse(eqx.tree_at(lambda p: (p.weights, p.tau_unit), problem, known))

    def _coarse(self, problem: InverseProblem) -> InverseProblem:
        found = None if self.size == 1 else on_blocks(problem, self.size)
        return problem if found is None else found

    def blocks(self, values: Numbers) -> Float[np.ndarray, "*batch block"]:
        """Sums over blocks of pixels."""
        values = np.asarray(values)
        shape = values.shape[-2:]
        rows, columns = (-(-n // self.block) * self.block for n in shape)
        padded = np.zeros((*values.shape[:-2], rows, columns))
        padded[..., : shape[0], : shape[1]] = values
        return block_sum(padded, self.block).reshape(*values.shape[:-2], -1)


class _Scenes(Trials):
    """Reconstructs the scene with a PSF."""

    def __call__(self, psf: np.ndarray) -> _Tried:
        problem = self._problem(psf)
        outcome = iterate(
            in_parallel(problem, admm_method),
            first_image(problem, None, uniform=False),
            Schedule(_ITERATIONS, 1e-6, adapt_until=_ITERATIONS // 2),
        )
        found, misfits = _parts(problem, outcome.image)
        return _Tried(float(found), self.blocks(misfits), outcome.image)

    def slopes(self, image: Image, psfs: list[np.ndarray], step: float) -> np.ndarray:
        """∂J/∂s of each block, of three PSFs of which the outer ones differ by `step`."""
        return self.blocks(_slopes([self._problem(psf) for psf in psfs], image) / step)

    def _problem(self, psf: np.ndarray) -> InverseProblem:
        model = self.recording.imaging_model
        assert isinstance(model, Psfs)
        return self.problem(replace(model, psfs=psf))


@eqx.filter_jit
def _parts(problem: InverseProblem, image):
    """The objective, and ½ w r² of each pixel, summed over captures and channels."""
    missing = residuals(problem, image)
    squares = [w * r**2 / 2 for w, r in zip(problem.weights, missing, strict=True)]
    return jnp.sum(objective(problem, image)), _summed(squares)


@eqx.filter_jit
def _slopes(problems: list[InverseProblem], image):
    """w r Δ(h ∗ f) of each pixel, summed over captures and channels."""
    below, at, above = problems
    parts = zip(at.weights, residuals(at, image), below.operators, above.operators, strict=True)
    return _summed([w * r * (forward(b, image) - forward(a, image)) for w, r, a, b in parts])


def _summed(parts):
    each = [jnp.sum(p.reshape(-1, *p.shape[-2:]), axis=0) for p in parts]
    return sum(each[1:], start=each[0])


def _oriented(psf: np.ndarray, number: int) -> np.ndarray:
    """The PSF in one of `ORIENTATIONS`, cropped or zero-padded to its own shape."""
    mirrored = psf[..., ::-1] if number >= 4 else psf
    turned = np.rot90(mirrored, number % 4, axes=(-2, -1))
    for axis in (-2, -1):
        excess = turned.shape[axis] - psf.shape[axis]
        if excess > 0:
            turned = turned.take(range(excess // 2, excess // 2 + psf.shape[axis]), axis=axis)
        elif excess < 0:
            width = [(0, 0)] * psf.ndim
            width[axis] = (-excess // 2, -excess - -excess // 2)
            turned = np.pad(turned, width)
    return turned


def scaled_psf(
    psf: Float[np.ndarray, "*batch k l"], scale: float
) -> Float[np.ndarray, "*batch k l"]:
    """The PSF enlarged about its centre, by cubic splines, with its sum and nearly its sharpness.

    A sharper PSF needs less detail in the image, and so explains a capture at a lower cost, right
    or wrong: its power spectrum is adjusted towards that of the PSF given.
    """
    if scale == 1:
        return psf
    planes = psf.reshape(-1, *psf.shape[-2:])
    changed = resampled(planes, np.eye(2) / scale)
    wanted, found = (np.fft.rfft2(images) for images in (planes, changed))
    frequency = np.hypot(
        *np.meshgrid(np.fft.fftfreq(psf.shape[-2]), np.fft.rfftfreq(psf.shape[-1]), indexing="ij")
    )
    for before, after in zip(wanted, found, strict=True):
        after *= _sharpness(before, after, frequency)
    return np.fft.irfft2(found, psf.shape[-2:]).reshape(psf.shape).astype(psf.dtype)


def resampled(
    planes: Float[np.ndarray, "plane k l"], matrix: np.ndarray, shift: np.ndarray | float = 0.0
) -> Float[np.ndarray, "plane k l"]:
    """h(M r) about the centre, then shifted by (y, x) pixels, by cubic splines."""
    middle = (np.array(planes.shape[-2:]) - 1) / 2
    start = middle - matrix @ (middle + shift)
    return np.stack(
        [scipy.ndimage.affine_transform(p, matrix, start, mode="nearest") for p in planes]
    )


def _sharpness(wanted: np.ndarray, found: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """The gain exp(a + b ν²) that matches the power of one spectrum to another, 1 at ν = 0."""
    ring = np.round(frequency * _RINGS).astype(int).ravel()
    power, other = (np.bincount(ring, np.abs(s.ravel()) ** 2)[1:] for s in (wanted, found))
    radius = np.arange(1, len(power) + 1) / _RINGS
    used = (power > 0) & (other > 0)
    ratio = _SHARE * np.log(power[used] / other[used]) / 2
    slope, level = np.polyfit(radius[used] ** 2, ratio, 1, w=np.sqrt(power[used]))
    gain = np.exp(level + slope * frequency**2)
    gain[0, 0] = wanted[0, 0].real / found[0, 0].real
    return gain


def _best_orientation(found: list[_Tried]) -> int:
    """The orientation of lowest objective, if significantly better than the one given."""
    best = min(range(len(found)), key=lambda k: found[k].objective)
    gains = found[0].misfits - found[best].misfits
    spread = np.std(gains) * math.sqrt(gains.size)
    better = found[0].objective - found[best].objective
    is_clear = better > _LEAST_GAIN * found[best].objective
    return best if is_clear and np.sum(gains) > _SIGNIFICANCE * spread else 0


def _vertex(scales: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Where the parabola through the values is lowest, within the scales, and its curvature."""
    middle = scales.mean()
    curvature, slope, _ = np.polyfit(scales - middle, values, 2)
    if curvature <= 0:
        return float(scales[np.argmin(values)]), 0.0
    vertex = np.clip(middle - slope / (2 * curvature), scales[0], scales[-1])
    return float(vertex), float(2 * curvature)
