"""Refine measured PSFs and computed cameras by captures (docs/measured/refine.md)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.progress import watched
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.psf_check import Trials, blocks_blur, on_blocks, resampled, searched
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.solver import first_image
from thincam_jax.reconstruction.splittings import admm_method

# Pixels of the longer side, at least, that the blocks of a large capture leave, and the part of the
# PSF's variance that blocks keep without which these are half as large.
_SIDE, _KEPT = 100, 0.75
# Iterations from a black image, from the image of a model nearby, and where only a rough idea is
# needed. Fewer than 200 from black move scales by up to 0.7 %.
_COLD, _NEARBY, _WARM = 400, 200, 60
_STEPS = 5  # of Gauss and Newton
_CHANGE = 0.2  # of the PSF's norm, by one step of the differences
_UNCHANGED = 0.01  # of the PSF's norm: it does not depend on the number
_ENDED = 0.1  # of a step of the differences
_DETERMINED = (
    1 / 3
)  # of the range searched: the largest standard error of a number that is determined
# Standard errors by which hidden pixels must be predicted better, and by what part of the squared
# residual: with less images gain nothing, and a wrong scale may cost a decibel.
_SIGNIFICANCE, _LEAST_GAIN = 2.0, 0.01

_TURN, _SHIFT, _BLUR = 0.035, 3.0, 1.0  # ranges searched: rad, pixels, pixels²
# Standard error of a blur at the least, pixels²: total variation blurs, a sharper PSF undoes it.
_BLUR_ERROR = 0.2
_OF_PSFS, _OF_CAMERAS = ("scale", "turn", "shift", "blur"), ("distance", "object_distance")


@dataclass(frozen=True)
class Refinement:
    """Result of `refine`.

    - `recording`: the one given with the refined PSFs or cameras, its `imaging_model`. It is the
      one given where hidden pixels are not predicted better by two standard errors and 1 %.
    - `values`, `errors`, `units`: numbers that fit best and their standard errors. `scale` is that
      of the PSF that fits over the one given, `turn` is anticlockwise in rad, `blur` the variance
      in pixels² to add, `shift_y 2` that of the second PSF against the first in pixels. Distances
      are in mm; `distance` is that of the furthest camera, the others change in proportion.
    - `undetermined`: numbers that the captures do not determine, left as given, with the reason.
    - `noise_ratio_before`, `noise_ratio`: rms of the residual of hidden pixels over the noise.
    """

    recording: Recording
    values: dict[str, float]
    errors: dict[str, float]
    units: dict[str, str]
    undetermined: dict[str, str]
    noise_ratio_before: float
    noise_ratio: float
    is_changed: bool

    def __str__(self) -> str:
        """Residuals, numbers with their errors, and a line for each number left as given."""
        lines = [f"residual of hidden pixels {self.noise_ratio_before:.3f} times the noise"]
        lines += self.numbers
        lines += [f"{name}: {reason}" for name, reason in self.undetermined.items()]
        last = f"refined {self.noise_ratio:.3f} times" if self.is_changed else "unchanged"
        return "\n".join([*lines, last])

    @property
    def numbers(self) -> list[str]:
        """Numbers with their errors and units, in words."""
        found = ((value, self.errors[n], self.units[n], n) for n, value in self.values.items())
        return [f"{n} {value:.5g} ± {error:.2g} {unit}".rstrip() for value, error, unit, n in found]


@dataclass(frozen=True)
class _Unknown:
    """A number to find: its value as given, and how far it is searched to either side."""

    name: str
    unit: str
    given: float
    search: float


@dataclass(frozen=True, eq=False)
class _Fit:
    """Numbers at the least squares, their standard errors, and the residuals there."""

    values: np.ndarray
    errors: np.ndarray
    residual: np.ndarray


@checked
@watched("refining the model")
def refine(
    recording: Recording,
    *,
    parameters: Sequence[str] | None = None,
    search: float | int = 0.06,
    tau: float | int = 0.5,
    callback: Callable[[int], object] | None = None,
) -> Refinement:
    r"""Correct PSFs or cameras that are slightly wrong, from captures of any scene.

    Pixels are parted at random into halves A and B. With the numbers θ of the imaging model, the
    scene is reconstructed from one half, and compared on the other:

    .. math:: f_A(\theta) = \arg\min_{f \ge 0} \tfrac12 \|H_\theta f - g\|_A^2 + \tau R(f), \qquad
        C(\theta) = \tfrac12 \|H_\theta f_A - g\|_B^2 + \tfrac12 \|H_\theta f_B - g\|_A^2

    with the residuals in units of the noise. C is minimised by Gauss and Newton's method, with the
    image eliminated (variable projection, Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973);
    the residuals r, f's response to θ included, are differentiated by central differences D.
    With b blocks of pixels the errors are those of an estimate whose model is wrong (White,
    Econometrica 50, 1, 1982), joined by the change of θ between 2τ and τ/2:

    .. math:: \Sigma = (D^TD)^{-1} \Big(\sum_b q_b q_b^T\Big) (D^TD)^{-1}, \qquad q_b = D_b^T r_b

    A number whose standard error exceeds a third of its range is left as given, and so is one that
    ends beyond it; of two that the captures cannot separate, the one known less (the errors of
    the other hold if it is right).

    - **Measured PSFs**: "scale", "turn" (within 2°), "blur" (within 1 pixel²), and "shift" (3
      pixels) between the PSFs of several captures. A shift of all is one of the scene. A blur
      changes with τ as much as with the PSF, and is seldom determined.
    - **Computed cameras**: "distance" and "object_distance", which the PSF of a far object hardly
      depends on.

    **Arguments**

    - `recording`: captures of at least 32 pixels a side with `Psfs` or `Cameras`. Of those with
      PSFs blocks of pixels are averaged until the longer side has 100 to 200, twice as many where
      that would blur the PSF; give few pixels with cameras. 30 to 100 reconstructions are made.
    - `parameters`: names of the above; default all.
    - `search`: range of scale and distances about those given, at most 0.2.
    - `tau`: weight of total variation, relative to the noise; see `AdmmTV`.
    - `callback`: called with the number of reconstructions done.

    **Errors**: ValueError, one line, for recordings without PSFs or cameras, and numbers out of
    range; TypeError inside jit.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf, seen = np.random.default_rng(0).random((2, 1, 32, 40))
    recording = tc.Recording(seen, tc.Psfs(psf[..., :13, :13]), noise_variance=1e-4)
    found = tc.refine(recording, parameters=["shift"])
    print(found.undetermined["shift"])  # one capture cannot determine it: the scene shifts instead
    ```

    **See also**: `check_psf`, `fit_psf`.
    """
    model = recording.imaging_model
    if not isinstance(model, Psfs | Cameras):
        raise ValueError("operators have no numbers to refine; give a recording with tc.Psfs")
    if any(map(checks.is_traced, jax.tree.leaves(recording))):
        raise TypeError("refine searches: call it outside jit and grad")
    shape, search = searched(recording, search, 0.2)
    possible = _OF_PSFS if isinstance(model, Psfs) else _OF_CAMERAS
    names = possible if parameters is None else tuple(parameters)
    if not names or not set(names) <= set(possible):
        raise ValueError(f"parameters = {list(names)}; give some of {', '.join(possible)}")
    size = _block(recording)
    unknowns, reasons = _unknowns(model, names, search, size)
    work = _Search(recording, float(tau), unknowns, callback, size)
    before = _Fit(work.given, np.zeros(0), work.residual(work.given, None, _COLD))
    active = [k for k, step in enumerate(work.steps) if step > 0]
    for k in set(range(len(unknowns))).difference(active):
        reasons[unknowns[k].name] = "the PSF hardly depends on it"
    start = work.coarse(2 * size / max(shape)) if "scale" in names else work.given
    fit = before
    while active:
        fit = work.fit(start, active)
        worst, reason = work.doubt(fit, active)
        if not reason:
            break
        reasons[unknowns[active[worst]].name] = reason
        start = fit.values.copy()
        start[active[worst]] = work.given[active[worst]]
        del active[worst]
        fit = before
    gains = work.blocks(before.residual**2 - fit.residual**2).ravel()
    least = _SIGNIFICANCE * math.sqrt(gains.size) * np.std(gains)
    better = bool(np.sum(gains) > max(least, _LEAST_GAIN * np.sum(before.residual**2)))
    if better:
        recording = replace(recording, imaging_model=work.model(fit.values))
    found = [unknowns[k].name for k in active]
    first, last = (
        math.sqrt(np.sum(f.residual**2) / work.pixels) for f in (before, fit if better else before)
    )
    values, errors = fit.values[active].tolist(), fit.errors.tolist()
    values, errors = (dict(zip(found, each, strict=True)) for each in (values, errors))
    units = {unknowns[k].name: unknowns[k].unit for k in active}
    return Refinement(recording, values, errors, units, reasons, first, last, better)


class _Search(Trials):
    """Residuals of hidden pixels at any numbers, and their least squares."""

    def __init__(
        self, recording: Recording, tau: float, unknowns: list[_Unknown], callback, size: int = 1
    ):
        super().__init__(recording, tau, size)
        self.unknowns, self.callback, self.done = unknowns, callback, 0
        self.given = np.array([u.given for u in unknowns])
        generator = np.random.default_rng(0)
        masks = [generator.random(c.shape) < 0.5 for c in self.captures]
        self.halves = masks, [~mask for mask in masks]
        self.images: list[Image] = []

    def model(self, values: np.ndarray) -> Psfs | Cameras:
        """The imaging model with these numbers."""
        model: Any = self.recording.imaging_model
        return _moved(model, {u.name: float(v) for u, v in zip(self.unknowns, values, strict=True)})

    def residual(
        self,
        values: np.ndarray,
        starts: list[Image] | None,
        iterations: int,
        tau: float | None = None,
    ) -> Float[np.ndarray, "capture v u"]:
        """(H f − g)/σ of each pixel, f from the half without it; leaves the two `images`."""
        problem = self.problem(self.model(values))
        problem = eqx.tree_at(lambda p: p.tau, problem, jnp.full_like(problem.tau, tau or self.tau))
        schedule = Schedule(iterations, 1e-6, adapt_until=iterations // 2)
        found, self.images = [], []
        for number, masks in enumerate(self.halves):
            pairs = zip(problem.weights, masks, strict=True)
            weights = tuple(w * m.astype(w.dtype) for w, m in pairs)
            half = eqx.tree_at(lambda p: p.weights, problem, weights)
            first = first_image(half, None, uniform=False) if starts is None else starts[number]
            image = iterate(in_parallel(half, admm_method), first, schedule).image
            missing = _residuals(half, image)
            parts = zip(problem.weights, masks, missing, strict=True)
            hidden = [np.where(m, 0, np.sqrt(w) * np.asarray(r, float)) for w, m, r in parts]
            found.append(np.concatenate([h.reshape(-1, *h.shape[-2:]) for h in hidden]))
            self.images.append(image)
        self.done += 2
        if self.callback is not None:
            self.callback(self.done)
        return found[0] + found[1]

    @cached_property
    def steps(self) -> np.ndarray:
        """Steps of the differences: the PSF changes as much by each; 0 if it hardly does."""
        kernel = self._kernel(self.given)
        small = np.array([u.search for u in self.unknowns]) / 16
        changes = [np.linalg.norm(self._kernel(self.given + d) - kernel) for d in np.diag(small)]
        change = np.array(changes) / np.linalg.norm(kernel)
        steps = small * np.minimum(_CHANGE / np.maximum(change, 1e-9), 8.0)
        return np.where(8 * change > _UNCHANGED, steps, 0.0)

    def coarse(self, pixel: float) -> np.ndarray:
        """The best of scales a pixel apart at the edge."""
        k = [u.name for u in self.unknowns].index("scale")
        count = math.ceil(self.unknowns[k].search / pixel)
        along = pixel * np.eye(len(self.given))[k]
        tried = [self.given + n * along for n in range(-count, count + 1)]
        return min(tried, key=lambda values: np.sum(self.residual(values, None, _WARM) ** 2))

    def fit(self, values: np.ndarray, active: list[int]) -> _Fit:
        """Least squares of some numbers by Gauss and Newton, and their errors."""
        residual = self.residual(values, None, _COLD)
        images, steps = self.images, self.steps[active]
        ranges = np.array([self.unknowns[k].search for k in active])
        left = _STEPS
        while True:
            slopes = self._slopes(values, active, images)
            prior = np.mean(residual**2) / ranges**2
            inverse = np.linalg.inv(slopes @ slopes.T + np.diag(prior))
            pull = slopes @ residual.ravel() + prior * (values - self.given)[active]
            move = -inverse @ pull
            move /= max(1.0, np.max(np.abs(move) / (2 * steps)))
            moved = values.copy()
            moved[active] += move
            left -= 1
            if not left or np.all(np.abs(move) < _ENDED * steps):
                break
            found = self.residual(moved, images, _NEARBY)
            if np.sum(found**2) >= np.sum(residual**2):
                break
            values, residual, images = moved, found, self.images
        each = slopes.reshape(len(active), *residual.shape) * residual
        parts = np.concatenate(list(self.blocks(each).swapaxes(0, 1)), axis=-1)
        spread = np.cov(parts, bias=True).reshape(len(active), -1) * parts.shape[-1]
        covariance = inverse @ (spread + np.diag(prior)) @ inverse
        rough, fine = (self.residual(values, images, _NEARBY, self.tau * f) for f in (2, 0.5))
        by_tau = inverse @ (slopes @ (rough - fine).ravel()) / 2
        is_blur = np.array([self.unknowns[k].name == "blur" for k in active])
        variance = np.diag(covariance) + by_tau**2 + (_BLUR_ERROR * self.size**2 * is_blur) ** 2
        return _Fit(values, np.sqrt(variance), residual)

    def doubt(self, fit: _Fit, active: list[int]) -> tuple[int, str]:
        """The number determined worst, and why it is left; nothing if all are determined."""
        unknowns = [self.unknowns[k] for k in active]
        limits = np.array([u.search for u in unknowns])
        away = np.abs(fit.values - self.given)[active]
        is_blur = np.array([u.name == "blur" for u in unknowns])
        doubts = np.maximum(fit.errors / (_DETERMINED * limits), away / limits)
        doubts += is_blur & (away < 2 * fit.errors)
        worst = int(np.argmax(doubts))
        value, error = fit.values[active[worst]], fit.errors[worst]
        found = f"{value:.4g} ± {error:.2g} {unknowns[worst].unit}".rstrip()
        why = (
            "beyond the search" if away[worst] > limits[worst] else "not determined by the captures"
        )
        return worst, f"{why}, {found}" if doubts[worst] > 1 else ""

    def _slopes(self, values, active, images) -> Float[np.ndarray, "unknown number"]:
        found = []
        for step in np.diag(self.steps)[active]:
            above, below = (self.residual(values + s * step, images, _WARM) for s in (1, -1))
            found.append((above - below).ravel() / (2 * np.sum(step)))
        return np.stack(found)

    def _kernel(self, values: np.ndarray) -> np.ndarray:
        leaves = jax.tree.leaves(self.problem(self.model(values)).operators)
        return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in leaves])


_residuals = eqx.filter_jit(residuals)


def _block(recording: Recording) -> int:
    """Side of the blocks that leave enough pixels, or twice as many where these blur the PSF.

    One pixel for computed cameras.
    """
    model, side = recording.imaging_model, max(recording.captures[0].shape[-2:])
    if not isinstance(model, Psfs):
        return 1
    fine, coarse = (max(1, side // pixels) for pixels in (2 * _SIDE, _SIDE))
    size = fine if blocks_blur(np.asarray(model.psfs), fine, _KEPT) else coarse
    return size if size == 1 or on_blocks(recording.problem(), size) is not None else 1


def _unknowns(
    model: Psfs | Cameras, names: tuple[str, ...], search: float, size: int = 1
) -> tuple[list[_Unknown], dict[str, str]]:
    """The numbers to find, and those that cannot be; `size`: side of the blocks of pixels."""
    if isinstance(model, Cameras):
        furthest, focus = _distances(model)
        possible = [
            _Unknown("distance", "mm", furthest, search * furthest),
            _Unknown("object_distance", "mm", focus, search * focus),
        ]
    else:
        possible = [
            _Unknown("scale", "", 1.0, search),
            _Unknown("turn", "rad", 0.0, _TURN),
            _Unknown("blur", "pixels²", 0.0, _BLUR * size**2),
        ]
        numbers = range(2, model.count + 1)
        shifts = [f"shift_{axis} {number}" for number in numbers for axis in "yx"]
        possible += [_Unknown(name, "pixels", 0.0, _SHIFT * size) for name in shifts]
    wanted = [u for u in possible if u.name.startswith(names)]
    reasons = {u.name: "it is infinite" for u in wanted if not math.isfinite(u.given)}
    if "shift" in names and model.count == 1:
        reasons["shift"] = "one capture cannot determine it: the scene shifts instead"
    return [u for u in wanted if u.name not in reasons], reasons


def _moved(model: Psfs | Cameras, values: dict[str, float]) -> Psfs | Cameras:
    """An imaging model with other numbers."""
    if isinstance(model, Cameras):
        furthest, focus = _distances(model)
        ratio = values.get("distance", furthest) / furthest
        cameras = [replace(c, distance=float(c.distance) * ratio) for c in model.cameras]
        if "object_distance" not in values:
            return replace(model, cameras=cameras)
        planes = np.asarray(model.object_distance, float) * (values["object_distance"] / focus)
        focus = planes if planes.ndim else float(planes)
        return replace(model, cameras=cameras, object_distance=focus)
    shifts = [
        (values.get(f"shift_y {n}", 0.0), values.get(f"shift_x {n}", 0.0))
        for n in range(1, model.count + 1)
    ]
    pairs = zip(np.asarray(model.psfs), shifts, strict=True)
    return replace(model, psfs=np.stack([changed_psf(psf, values, s) for psf, s in pairs]))


def _distances(model: Cameras) -> tuple[float, float]:
    """The largest mask-sensor distance, and the object distance of the first plane."""
    distances = [float(camera.distance) for camera in model.cameras]
    return max(distances), float(np.ravel(np.asarray(model.object_distance, float))[0])


def changed_psf(
    psf: Float[np.ndarray, "*batch k l"],
    values: dict[str, float],
    shift: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "*batch k l"]:
    """A PSF by a `Refinement`'s scale, turn and blur, then shifted by pixels, with its sum."""
    scale, turn = values.get("scale", 1.0), values.get("turn", 0.0)
    blur = values.get("blur", 0.0)
    if (scale, turn, blur, *shift) == (1.0, 0.0, 0.0, 0.0, 0.0):
        return psf
    planes = psf.reshape(-1, *psf.shape[-2:]).astype(float)
    cos, sin = math.cos(turn), math.sin(turn)
    found = resampled(planes, np.array([[cos, sin], [-sin, cos]]) / scale, np.array(shift))
    v, u = np.fft.fftfreq(psf.shape[-2])[:, None], np.fft.rfftfreq(psf.shape[-1])
    gain = np.exp(-2 * np.pi**2 * blur * (v**2 + u**2))
    found = np.fft.irfft2(np.fft.rfft2(found) * gain, psf.shape[-2:])
    found *= (planes.sum(axis=(-2, -1)) / found.sum(axis=(-2, -1)))[:, None, None]
    return found.reshape(psf.shape).astype(psf.dtype)
