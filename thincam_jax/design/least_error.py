r"""Limit of a design: the least expected error that any mask of a kind can have.

`bayes_error` depends on the captures through the power |H|² of each frequency and their light. Let
a PSF hold T of the light that the open mask lets through, A = (Mw)². Then |H| ≤ H(0) = T, and

- "shadow": a PSF that is the mask's shadow has 0 ≤ h ≤ 1. Without its mean over the shadow, its
  energy is :math:`\int |\hat\delta|^2 du \le T - T^2/A` (Parseval and h² ≤ h), and
  :math:`|H| \le T|D| + |\hat\delta|`, with D the response of the open mask over A;
- "amplitude": with 0 ≤ t ≤ 1 and Fresnel diffraction, :math:`|H| \le A'\sin(\pi T/A')/\pi` up to
  T = A'/2, where A' is the overlap of the aperture with itself, moved by λν, times 1 + 1/N for N
  fringes across it;
- "phase": with |t| ≤ 1 and Fresnel diffraction, |H| ≤ min(T, overlap), which a lens attains.

The least error over all powers within these bounds is a convex problem. Its dual bounds the error
of every mask from below; docs/theory/index.md derives it.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq, minimize_scalar

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.response import spectral_density
from thincam_jax.design.setup import PhotonNoise, Quadrant, Setup
from thincam_jax.design.space import DesignSpace

Masks = Literal["shadow", "amplitude", "phase"]
KINDS: tuple[Masks, ...] = ("shadow", "amplitude", "phase")
_NEWTON = 60  # most steps to a response
_TOLERANCE, _STEP = 1e-3, 1e-4  # of a search; of a share for its derivative, relative


@dataclass(frozen=True, eq=False)
class Limit:
    """Least expected error of all masks of a kind.

    - `error`: the dual's value, as a part of the scene's variance: no mask has less.
    - `attained`: the error of `ratio`, which keeps all bounds.
    - `ratio`: signal-to-noise ratio η_f J of each frequency of the problem's `Quadrant`.
    - `transmission`: the part of the light that is let through there.
    - `masks`: kind of masks.
    """

    error: float
    attained: float
    ratio: Float[np.ndarray, "row column"]
    transmission: float
    masks: Masks

    @property
    def decibels(self) -> float:
        """`error` as `BayesError` reports it, dB."""
        return 10 * math.log10(self.error)

    @property
    def gap(self) -> float:
        """Certificate: `attained` over `error`, dB. The problem's optimum lies between them."""
        return 10 * math.log10(self.attained / self.error)

    def above(self, error: float) -> float:
        """How far a design of such a `bayes_error` lies above the limit, dB."""
        return 10 * math.log10(error) - self.decibels


@checked
def limit(problem: DesignProblem, *, masks: Masks = "shadow") -> Limit:
    """Least `bayes_error` of any masks in place of the zone apertures of a problem.

    The masks are as wide as the problem allows, at its longest distance and shortest wavelength;
    there are as many captures in the same time. Captures whose exposures differ or are free count
    as one that has all of the time, which is never worse. Takes seconds.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    design = tc.design.shots([12.0], 6.5, [0.0], wavelength=500 * nm, width=1.4)
    setup = tc.design.Setup(44 * um, 1.4, 250.0, 179.0, noise=tc.design.PhotonNoise(2e4))
    space = tc.design.DesignSpace(design, (tc.design.Variable("beta", 6.0, 20.0, (0,)),))
    problem = tc.design.design_problem(tc.design.BayesError(), space, setup, [[1.0]])
    least = tc.design.limit(problem)
    least.above(float(tc.design.BayesError()(design, problem.best_data)))  # dB
    ```

    **Validity**: that of `bayes_error`, for PSFs that do not change over the field and light in
    proportion to T. What the sensor cuts off adds to a mask's error and is left out. Diffraction
    concentrates light: a zone plate that focuses on the sensor passes "shadow", not "amplitude".

    **Errors**: TypeError for noise that counts no electrons, and for a problem whose frequencies
    are not on a `Quadrant`.
    """
    checks.choice("masks", masks, KINDS)
    data = problem.best_data
    if not isinstance(getattr(data, "frequencies", None), Quadrant):
        raise TypeError(
            "a limit needs frequencies on a Quadrant; make the problem by design_problem"
        )
    noise = data.setup.noise
    if not isinstance(noise, PhotonNoise):
        raise TypeError("noise at an SNR does not know of light; give the setup PhotonNoise")
    scene = _Scene(problem.space, data.setup, noise, data.frequencies)
    return _limit_of_shadows(scene) if masks == "shadow" else _limit_by_overlap(scene, masks)


class _Scene:
    """A problem's numbers in double precision, for frequencies ν_y ≤ ν_x that stand for all.

    - `turns`: frequencies times the shadow's side as an angle, (y, x).
    - `spectrum`, `weight`: η_f and the area of each frequency.
    - `gain`: η_f J is η_f·gain·|H|²/(T + dark); `dark`: light as noisy as the read noise, mm².
    """

    def __init__(self, space: DesignSpace, setup: Setup, noise: PhotonNoise, frequencies: Quadrant):
        # Bounds grow with the distance, and a shorter wavelength diffracts less.
        distance, width = space.reach("distance")[1], space.reach("width")[1]
        side = (1 + distance / float(setup.object_distance)) * width
        self.area, self.solid = side**2, distance**2
        axis = np.asarray(frequencies.axis, float)
        self.shape, self.upper = (len(axis),) * 2, np.triu_indices(len(axis))
        along = axis[np.stack(self.upper)]
        self.turns = along * side / distance
        shifted = np.maximum(1 - space.reach("wavelength")[0] * along / width, 0.0)
        self.shifted, self.overlap = shifted, self.area * np.prod(shifted, axis=0)
        twice = np.where(self.upper[0] == self.upper[1], 1.0, 2.0)
        self.weight = np.asarray(frequencies.weight, float)[self.upper] * twice
        self.spectrum = np.asarray(spectral_density(setup, frequencies), float)[self.upper]
        self.total = float(np.sum(self.weight * self.spectrum))
        captures, exposure = _equal_exposures(space)
        pitch, field = float(setup.pitch), float(setup.field)
        counted = float(noise.electrons) * exposure
        seen = min(1.0, field * distance / side) ** 2
        self.dark = float(noise.read_noise) ** 2 / (counted * seen)
        self.gain = captures * counted / seen * self.solid / pitch**2
        if setup.pixel_integration:
            self.gain = self.gain * np.prod(np.sinc(pitch * along / distance) ** 2, axis=0)

    def error(self, ratio: np.ndarray) -> float:
        """The part of the variance that is left at such signal-to-noise ratios."""
        return float(np.sum(self.weight * self.spectrum / (1 + ratio))) / self.total

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Values on the whole `Quadrant`."""
        square = np.empty(self.shape)
        square[self.upper] = values
        square.T[self.upper] = values
        return square


def _equal_exposures(space: DesignSpace) -> tuple[int, float]:
    """Number of captures and the exposure of each: one that has all where they differ."""
    given = np.array(space.base.exposure, float)
    free = [v for v in space.variables if v.name == "exposure"]
    if not free and np.ptp(given) == 0:
        return len(given), float(given[0])
    for variable in free:
        given[list(variable.captures)] = variable.upper
    return 1, float(space.limits.exposure or np.sum(given))


def _limit_of_shadows(scene: _Scene) -> Limit:
    """The least over the share T²/(T + dark), in which the problem is convex."""
    # D, by an envelope that falls with the distance as the other bounds do.
    lobe = np.prod(1 / np.maximum(np.pi * scene.turns, 1.0), axis=0)
    most = scene.area**2 / (scene.area + scene.dark)

    def light(share: float) -> float:
        return (share + math.sqrt(share**2 + 4 * share * scene.dark)) / 2

    def filling(share: float) -> _Filling:
        root, passed = math.sqrt(share), light(share)
        energy = passed * (1 - passed / scene.area) / (passed + scene.dark)
        # Over u = ν/d.
        return _Filling(scene, energy * scene.solid, root * lobe, root * (1 - lobe))

    def attained(logarithm: float) -> float:
        return filling(math.exp(logarithm)).attained

    end = math.log(most)
    share = math.exp(_place_of_least(attained, end - 14, end - 2 * _STEP))
    best = filling(share)
    # At one price the dual is convex in the share: it lies above its chords, continued.
    step, here = _STEP * share, best.dual(best.price)
    falls = (here - filling(share - step).dual(best.price)) / step
    rises = (filling(share + step).dual(best.price) - here) / step
    error = here + min(0.0, falls * (most - share), -rises * share)
    passed = light(share) / scene.area
    return Limit(error, best.attained, scene.whole(best.ratio), passed, "shadow")


def _place_of_least(cost: Callable[[float], float], low: float, high: float) -> float:
    options = {"xatol": _TOLERANCE}
    found: Any = minimize_scalar(cost, bounds=(low, high), method="bounded", options=options)
    return float(found.x)


class _Filling:
    r"""Least error at responses a + v of energy :math:`\sum w v^2` within a budget, v ≤ `most`.

    Water-filling: v minimises η/(1 + ηG(a + v)²) + μ v² at a price μ that uses up the budget. The
    derivative is zero where :math:`(b - b_0)(1 + b^2)^2 = b\,\eta^2 G/\mu`, b = (a + v)√(ηG) and
    b₀ = a√(ηG). The sum of these, less μ times the budget, is the dual, a bound at any μ ≥ 0.
    """

    def __init__(self, scene: _Scene, budget: float, offset: np.ndarray, most: np.ndarray):
        self.scene, self.budget, self.offset, self.most = scene, budget, offset, most
        self.root = np.sqrt(scene.spectrum * scene.gain)

    def above(self, price: float) -> np.ndarray:
        """v."""
        if price == 0:
            return self.most
        least, slope = self.offset * self.root, self.root**2 * self.scene.spectrum / price
        b = least + slope**0.25  # beyond the root of a convex function: Newton's steps descend
        for _ in range(_NEWTON):
            square = 1 + b**2
            excess = (b - least) * square**2 - slope * b
            change = excess / (square**2 + 4 * (b - least) * b * square - slope)
            b = b - change
            if np.max(np.abs(change)) < 1e-12 * np.max(b):
                break
        return np.clip((b - least) / self.root, 0.0, self.most)

    def used(self, price: float) -> float:
        return float(np.sum(self.scene.weight * self.above(price) ** 2))

    @functools.cached_property
    def price(self) -> float:
        if self.used(0.0) <= self.budget:
            return 0.0

        def excess(logarithm: float) -> float:
            used = self.used(math.exp(logarithm))
            return (used - self.budget) / (used + self.budget)

        about = math.log(self.scene.total / self.budget)
        return math.exp(float(brentq(excess, about - 60, about + 20, xtol=1e-8)))  # pyright: ignore

    @functools.cached_property
    def ratio(self) -> np.ndarray:
        return self._ratio(self.above(self.price))

    @property
    def attained(self) -> float:
        return self.scene.error(self.ratio)

    def dual(self, price: float) -> float:
        above = self.above(price)
        paid = price * (float(np.sum(self.scene.weight * above**2)) - self.budget)
        return self.scene.error(self._ratio(above)) + paid / self.scene.total

    def _ratio(self, above: np.ndarray) -> np.ndarray:
        return (self.root * (self.offset + above)) ** 2


def _limit_by_overlap(scene: _Scene, masks: Masks) -> Limit:
    """The dual has each frequency at its own best light; attained is that of all at one."""
    overlap = best = np.maximum(scene.overlap, np.finfo(float).tiny)
    if masks == "amplitude":
        turns = np.max(scene.turns * scene.shifted, axis=0)
        with np.errstate(divide="ignore"):
            overlap = overlap * (1 + 1 / turns)
        best = np.minimum(_best_light(overlap, scene.dark), scene.area)

    def ratio(light) -> np.ndarray:
        response = np.minimum(light, overlap)
        if masks == "amplitude":
            passed = np.minimum(light, overlap / 2)
            response = passed * np.sinc(passed / overlap)
        return scene.spectrum * scene.gain * response**2 / (light + scene.dark)

    def attained(light: float) -> float:
        return scene.error(ratio(light))

    light = _place_of_least(attained, 1e-6 * scene.area, scene.area)
    found = scene.whole(ratio(light))
    return Limit(scene.error(ratio(best)), attained(light), found, light / scene.area, masks)


def _best_light(overlap: np.ndarray, dark: float) -> np.ndarray:
    """T of the largest sin²(θ)/(T + ρ) with θ = πT/A' ≤ π/2: tan θ = 2(θ + πρ/A')."""
    low, high = np.full_like(overlap, 1.0), np.full_like(overlap, np.pi / 2)
    for _ in range(50):
        angle = (low + high) / 2
        below = np.sin(angle) < 2 * (angle + np.pi * dark / overlap) * np.cos(angle)
        low, high = np.where(below, angle, low), np.where(below, high, angle)
    return high * overlap / np.pi
