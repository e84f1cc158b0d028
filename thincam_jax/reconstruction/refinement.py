r"""Refine an imaging model by captures: scale, turn, shift and blur of a PSF, a camera's distances.

Hidden pixels judge: an image is reconstructed from a random half of the pixels, and predicts those
of the other half. The objective of a reconstruction would prefer PSFs that are too sharp
(docs/measured/refine.md has the comparison).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.psf_check import Trials, resampled
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.solver import first_image
from thincam_jax.reconstruction.splittings import admm_method

# Iterations from a black image, from the image of a model nearby, and where only a rough idea is
# needed. Fewer than 200 from black move scales by up to 0.7 %.
_COLD, _NEARBY, _WARM = 400, 200, 60
_STEPS = 5  # of Gauss and Newton
_CHANGE = 0.2  # of the PSF's norm, by one step of the differences
_UNCHANGED = 0.01  # of the PSF's norm: it does not depend on the number
_ENDED = 0.1  # of a step of the differences
_TOLD = 1 / 3  # of the range searched: the largest standard error of a number that is told
_SIGNIFICANCE = 2.0  # standard errors by which hidden pixels must be predicted better

_TURN, _SHIFT, _BLUR = 0.035, 3.0, 1.0  # ranges searched: rad, pixels, pixels²
# Standard error at the least, pixels²: total variation smooths images, which a PSF too sharp undoes.
_BLUR_ERROR = 0.2
_OF_PSFS, _OF_CAMERAS = ("scale", "turn", "shift", "blur"), ("distance", "object_distance")


@dataclass(frozen=True)
class Refinement:
    """Result of `refine`.

    - `recording`: the one given with the refined PSFs or cameras, its `imaging_model`. It is the
      one given where hidden pixels are not predicted better by two standard errors.
    - `values`, `errors`, `units`: numbers that fit best and their standard errors. `scale` is that
      of the PSF that fits over the one given, `turn` is anticlockwise in rad, `blur` the variance
      in pixels² to add, `shift_y 2` that of the second PSF against the first in pixels. Distances
      are in mm; `distance` is that of the furthest camera, the others change in proportion.
    - `not_told`: the numbers that the captures do not tell, left as given, each with its reason.
    - `noise_ratio_before`, `noise_ratio`: rms of the residual of hidden pixels over the noise.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc

    psfs = tc.Psfs(np.random.default_rng(0).random((1, 13, 13)) ** 6)
    camera = tc.Recording(np.ones((1, 32, 40)), psfs).problem().operators[0]
    chart = jnp.zeros(camera.in_shape).at[..., 12:20, 16:26].set(1.0)
    recording = tc.Recording(np.asarray(camera(chart))[None], psfs, noise_variance=1e-4)
    print(tc.refine(recording, parameters=["turn"]).is_changed)  # False
    ```

    **See also**: `refine`.
    """

    recording: Recording
    values: dict[str, float]
    errors: dict[str, float]
    units: dict[str, str]
    not_told: dict[str, str]
    noise_ratio_before: float
    noise_ratio: float
    is_changed: bool

    def __str__(self) -> str:
        """Residuals, numbers with their errors, and a line for each number that is not told."""
        first = f"residual of hidden pixels {self.noise_ratio_before:.3f} times the noise"
        if self.is_changed:
            first += f", refined {self.noise_ratio:.3f}"
        found = [
            f"{name} {value:.5g} ± {self.errors[name]:.2g} {self.units[name]}".rstrip()
            for name, value in self.values.items()
        ]
        last = [] if self.is_changed else ["no other fits better: unchanged"]
        return "\n".join([first, *found, *(f"{n}: {r}" for n, r in self.not_told.items()), *last])


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
    ends beyond it; of two that the captures cannot tell apart, the one known less.

    - **Measured PSFs**: "scale", "turn" (within 2°), "blur" (within 1 pixel²), and "shift" (3
      pixels) between the PSFs of several captures. A shift of all is one of the scene. A blur
      changes with τ as much as with the PSF, and is seldom told.
    - **Computed cameras**: "distance" and "object_distance". One capture from afar tells neither:
      its PSF hardly depends on them.

    **Arguments**

    - `recording`: captures of at least 32 pixels a side with `Psfs` or `Cameras`. Average blocks
      of pixels until the longer side is 100 to 200; as many iterations as 30 to 100 reconstructions
      are made.
    - `parameters`: names of the above; default all.
    - `search`: range of scale and distances about those given, at most 0.2.
    - `tau`: as of `AdmmTV`.
    - `callback`: called with the number of reconstructions done.

    **Errors**: ValueError, one line, for recordings without PSFs or cameras, and numbers out of
    range; TypeError inside jit.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc

    psfs = tc.Psfs(np.random.default_rng(0).random((1, 13, 13)) ** 6)
    camera = tc.Recording(np.ones((1, 32, 40)), psfs).problem().operators[0]
    chart = jnp.zeros(camera.in_shape).at[..., 12:20, 16:26].set(1.0)
    recording = tc.Recording(np.asarray(camera(chart))[None], psfs, noise_variance=1e-4)
    found = tc.refine(recording, parameters=["turn"])
    print(abs(found.values["turn"]) < 0.01)  # True
    ```

    **See also**: `check_psf`, `fit_psf`.
    """
    model = recording.imaging_model
    if not isinstance(model, Psfs | Cameras):
        raise ValueError("operators have no numbers to refine; give a recording with tc.Psfs")
    if any(map(checks.is_traced, jax.tree.leaves(recording))):
        raise TypeError("refine searches: call it outside jit and grad")
    shape = recording.captures[0].shape[-2:]
    if min(shape) < 32:
        raise ValueError(f"captures have {shape} pixels; give at least 32 a side")
    search = float(checks.positive("search", search, "parts of one"))
    if search > 0.2:
        raise ValueError(f"search = {search:g} is too wide; give at most 0.2")
    possible = _OF_PSFS if isinstance(model, Psfs) else _OF_CAMERAS
    names = possible if parameters is None else tuple(parameters)
    if not names or not set(names) <= set(possible):
        raise ValueError(f"parameters = {list(names)}; give some of {', '.join(possible)}")
    unknowns, reasons = _unknowns(model, names, search)
    search_for = _Search(recording, float(tau), unknowns, callback)
    given = search_for.given
    before = search_for.residual(given, None, _COLD)
    start = search_for.coarse(max(shape)) if "scale" in names else given
    active = []
    for k, unknown in enumerate(unknowns):
        if search_for.steps[k] > 0:
            active.append(k)
        else:
            reasons[unknown.name] = "the PSF hardly depends on it"
    fit = None
    while active:
        fit = search_for.fit(start, active)
        ranges = np.array([unknowns[k].search for k in active])
        away = np.abs(fit.values - given)[active]
        doubts = np.maximum(fit.errors / (_TOLD * ranges), away / ranges)
        for k, blur in enumerate(unknowns[n].name == "blur" for n in active):
            doubts[k] += blur and away[k] < 2 * fit.errors[k]
        worst = int(np.argmax(doubts))
        if doubts[worst] <= 1:
            break
        unknown = unknowns[active.pop(worst)]
        reasons[unknown.name] = _reason(unknown, away[worst], fit.errors[worst])
        start = np.where(np.isin(np.arange(len(given)), active), fit.values, given)
        fit = None
    gains = np.zeros(1) if fit is None else search_for.gains(before, fit.residual)
    better = np.sum(gains) > _SIGNIFICANCE * math.sqrt(gains.size) * np.std(gains) > 0
    ratios = [math.sqrt(np.sum(r**2) / search_for.pixels) for r in (before, before)]
    if fit is not None and better:
        ratios[1] = math.sqrt(np.sum(fit.residual**2) / search_for.pixels)
        recording = replace(recording, imaging_model=search_for.model(fit.values))
    told = {} if fit is None else {unknowns[k].name: k for k in active}
    return Refinement(
        recording,
        {name: float(fit.values[k]) for name, k in told.items() if fit is not None},
        {name: float(e) for name, e in zip(told, () if fit is None else fit.errors, strict=True)},
        {name: unknowns[k].unit for name, k in told.items()},
        reasons,
        *ratios,
        bool(better),
    )


class _Search(Trials):
    """Residuals of hidden pixels at any numbers, and their least squares."""

    def __init__(self, recording: Recording, tau: float, unknowns: list[_Unknown], callback):
        super().__init__(recording, tau)
        self.unknowns, self.callback, self.done = unknowns, callback, 0
        self.given = np.array([u.given for u in unknowns])
        generator = np.random.default_rng(0)
        captures = recording.problem().captures
        masks = [generator.random(c.shape) < 0.5 for c in captures]
        self.halves = masks, [~mask for mask in masks]
        self.images: list[Image] = []

    def model(self, values: np.ndarray) -> Psfs | Cameras:
        """The imaging model with these numbers."""
        model = self.recording.imaging_model
        assert isinstance(model, Psfs | Cameras)
        return _moved(model, {u.name: float(v) for u, v in zip(self.unknowns, values, strict=True)})

    def residual(
        self,
        values: np.ndarray,
        starts: list[Image] | None,
        iterations: int,
        tau: float | None = None,
    ) -> Float[np.ndarray, "capture y x"]:
        """(H f − g)/σ of each pixel, f from the half without it; leaves the two `images`."""
        problem = self.problem(self.model(values))
        problem = eqx.tree_at(lambda p: p.tau, problem, jnp.full_like(problem.tau, tau or self.tau))
        found, self.images = 0, []
        schedule = Schedule(iterations, 1e-6, adapt_until=iterations // 2)
        for number, masks in enumerate(self.halves):
            weights = tuple(w * m for w, m in zip(self.weights, masks, strict=True))
            half = eqx.tree_at(lambda p: p.weights, problem, weights)
            first = first_image(half, None, uniform=False) if starts is None else starts[number]
            image = iterate(in_parallel(half, admm_method), first, schedule).image
            missing = zip(self.weights, masks, _residuals(half, image), strict=True)
            found = found + np.concatenate(
                [
                    np.asarray(jnp.where(m, 0, jnp.sqrt(w) * r), float).reshape(-1, *r.shape[-2:])
                    for w, m, r in missing
                ]
            )
            self.images.append(image)
        self.done += 2
        if self.callback is not None:
            self.callback(self.done)
        return found

    @cached_property
    def steps(self) -> np.ndarray:
        """Of the differences: such that the PSF changes as much by each number; 0 if it hardly does."""
        kernel = self._kernel(self.given)
        steps = []
        for k, unknown in enumerate(self.unknowns):
            most = unknown.search / 2
            values = self.given.copy()
            values[k] += most / 8
            small = np.linalg.norm(self._kernel(values) - kernel) / np.linalg.norm(kernel)
            step = most / 8 * min(_CHANGE / max(small, 1e-9), 8.0)
            steps.append(step if 8 * small > _UNCHANGED else 0.0)
        return np.array(steps)

    def coarse(self, side: int) -> np.ndarray:
        """The best of scales a pixel apart at the edge."""
        k = [u.name for u in self.unknowns].index("scale")
        pixel = 2 / side
        count = math.ceil(self.unknowns[k].search / pixel)
        tried = [self._at(k, 1 + n * pixel) for n in range(-count, count + 1)]
        return min(tried, key=lambda v: np.sum(self.residual(v, None, _WARM) ** 2))

    def fit(self, values: np.ndarray, active: list[int]) -> _Fit:
        """Least squares of some numbers by Gauss and Newton, and their errors."""
        residual = self.residual(values, None, _COLD)
        images, steps = self.images, self.steps[active]
        ranges = np.array([self.unknowns[k].search for k in active])
        for _ in range(_STEPS):
            slopes = self._slopes(values, active, images)
            prior = np.mean(residual**2) / ranges**2
            inverse = np.linalg.inv(slopes @ slopes.T + np.diag(prior))
            pull = slopes @ residual.ravel() + prior * (values - self.given)[active]
            move = -inverse @ pull
            move /= max(1.0, np.max(np.abs(move) / (2 * steps)))
            if np.all(np.abs(move) < _ENDED * steps):
                break
            moved = values.copy()
            moved[active] += move
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
        least = [_BLUR_ERROR * (self.unknowns[k].name == "blur") for k in active]
        errors = np.sqrt(np.diag(covariance) + by_tau**2 + np.square(least))
        return _Fit(values, errors, residual)

    def gains(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """By how much each block is predicted better."""
        return self.blocks((before**2 - after**2) / 2).ravel()

    def _slopes(self, values, active, images) -> Float[np.ndarray, "unknown number"]:
        found = []
        for k in active:
            above, below = (
                self.residual(self._at(k, values[k] + sign * self.steps[k], values), images, _WARM)
                for sign in (1, -1)
            )
            found.append((above - below).ravel() / (2 * self.steps[k]))
        return np.stack(found)

    def _at(self, k: int, value: float, values: np.ndarray | None = None) -> np.ndarray:
        moved = (self.given if values is None else values).copy()
        moved[k] = value
        return moved

    def _kernel(self, values: np.ndarray) -> np.ndarray:
        leaves = jax.tree.leaves(self.problem(self.model(values)).operators)
        return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in leaves])


_residuals = eqx.filter_jit(residuals)


def _unknowns(
    model: Psfs | Cameras, names: tuple[str, ...], search: float
) -> tuple[list[_Unknown], dict[str, str]]:
    """The numbers to find, and those that cannot be."""
    found, reasons = [], {}
    known = {
        "scale": _Unknown("scale", "", 1.0, search),
        "turn": _Unknown("turn", "rad", 0.0, _TURN),
        "blur": _Unknown("blur", "pixels²", 0.0, _BLUR),
    }
    if isinstance(model, Cameras):
        furthest = max(float(camera.distance) for camera in model.cameras)
        focus = float(np.ravel(np.asarray(model.object_distance, float))[0])
        known = {
            "distance": _Unknown("distance", "mm", furthest, search * furthest),
            "object_distance": _Unknown("object_distance", "mm", focus, search * focus),
        }
        if not math.isfinite(focus) and "object_distance" in names:
            reasons["object_distance"] = "it is infinite"
    for name in (n for n in names if n not in reasons):
        if name == "shift":
            found += [
                _Unknown(f"shift_{axis} {number}", "pixels", 0.0, _SHIFT)
                for number in range(2, model.count + 1)
                for axis in "yx"
            ]
            if model.count == 1:
                reasons[name] = "one capture cannot tell it: the scene shifts instead"
        else:
            found.append(known[name])
    return found, reasons


def _reason(unknown: _Unknown, away: float, error: float) -> str:
    unit = f" {unknown.unit}" if unknown.unit else ""
    if error > _TOLD * unknown.search:
        return f"the captures tell it only within {error:.2g}{unit}"
    if away <= unknown.search:
        return f"{away:.2g} ± {error:.2g}{unit}, not told from none"
    return f"it ends beyond {unknown.search:.2g}{unit} from the one given: it is not what is wrong"


def _moved(model: Psfs | Cameras, values: dict[str, float]) -> Psfs | Cameras:
    """An imaging model with other numbers."""
    if isinstance(model, Cameras):
        furthest = max(float(camera.distance) for camera in model.cameras)
        ratio = values.get("distance", furthest) / furthest
        cameras = [replace(c, distance=float(c.distance) * ratio) for c in model.cameras]
        focus = np.asarray(model.object_distance, float)
        focus = focus * (values.get("object_distance", focus.ravel()[0]) / focus.ravel()[0])
        return replace(model, cameras=cameras, object_distance=focus if focus.ndim else float(focus))
    shape = {name: values.get(name, start) for name, start in _AS_GIVEN.items()}
    moved = [
        changed_psf(
            np.asarray(psf),
            **shape,
            shift=(values.get(f"shift_y {n}", 0.0), values.get(f"shift_x {n}", 0.0)),
        )
        for n, psf in enumerate(model.psfs, start=1)
    ]
    return replace(model, psfs=np.stack(moved))


_AS_GIVEN = {"scale": 1.0, "turn": 0.0, "blur": 0.0}


def changed_psf(
    psf: Float[np.ndarray, "*batch k l"],
    *,
    scale: float = 1.0,
    turn: float = 0.0,
    blur: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "*batch k l"]:
    """A PSF enlarged, turned anticlockwise (rad), shifted (pixels) and blurred, with its sum.

    - `blur`: variance of a Gaussian, pixels²; a negative one sharpens.
    """
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
