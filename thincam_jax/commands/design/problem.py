"""What is searched for: the goal as a function of designs, and the numbers it takes."""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.commands.design.config import (
    DesignConfig,
    DesignNoiseConfig,
    Objective,
    SearchConfig,
)
from thincam_jax.commands.design.config_pareto import ParetoConfig
from thincam_jax.commands.design.simulated import build_study
from thincam_jax.commands.study.build import build_plane, synthesis_matrix
from thincam_jax.design import (
    Design,
    DesignSpace,
    PhotonNoise,
    Polar,
    PowerLaw,
    Quadrant,
    Setup,
    SignalNoise,
    Tolerances,
    bayes_error,
    channels,
    find_designs,
    fit_power_law,
    limit,
    robust_error,
    unevenness,
    worst_ratio_db,
)
from thincam_jax.design.frequencies import Frequencies
from thincam_jax.design.search import Search

DEFAULT_BAND = (0.05, 0.5)
# What is called worse by 1 %: 10 log10(1.01) dB for what is in dB.
RISE, _RISE_DB = 0.01, 0.0432

_MARGIN, _FEWEST = 1.1, 128  # of the samples that fringes need; at least


class Data(NamedTuple):
    """What a goal takes beside the design."""

    setup: Setup
    synthesis: Float[Array, "channel capture"]
    frequencies: Frequencies


@dataclass(frozen=True)
class Goal:
    """An objective to be made small; equal goals are compiled once.

    - `band`: of `worst_ratio` and `unevenness`.
    - `tolerances`, `how`: of `robust_error`.
    """

    name: Objective
    band: tuple[float, float] = DEFAULT_BAND
    tolerances: Tolerances = Tolerances()
    how: Literal["mean", "worst"] = "mean"

    def __call__(self, design: Design, data: Any) -> Float[Array, ""]:
        """What is made small: the negative of what is to be large."""
        value = self._value(design, data)
        return -value if self.wants_more else value

    def _value(self, design: Design, data: Any) -> Float[Array, ""]:
        if self.name == "robust_error":
            setup, synthesis, at = data
            return robust_error(design, setup, synthesis, at, self.tolerances, how=self.how)
        known = channels(design, data.setup, data.synthesis, data.frequencies)
        if self.name == "bayes_error":
            return bayes_error(known)
        if self.name == "limit":
            return limit(known, data.frequencies)
        if self.name == "unevenness":
            return unevenness(known, data.frequencies, self.band)
        return worst_ratio_db(known, data.frequencies, self.band)

    @property
    def wants_more(self) -> bool:
        """Whether larger values of the objective are better."""
        return self.name in ("worst_ratio", "limit")

    @property
    def unit(self) -> str:
        """Of `told`."""
        return "cycles/rad" if self.name == "limit" else "dB"

    @property
    def label(self) -> str:
        """What the objective is, in words, with the unit of `told`."""
        words = {
            "bayes_error": "predicted error over the scene's variance",
            "robust_error": "predicted error with the tolerances",
            "worst_ratio": "lowest signal-to-noise ratio of the band",
            "limit": "limit of resolution",
            "unevenness": "unevenness of the band",
        }
        return f"{words[self.name]} ({self.unit})"

    def told(self, minimised: Any) -> Any:
        """A value of the goal as it is shown: errors in dB, and what is to be large as it is."""
        value = np.asarray(minimised, dtype=float)
        if self.name in ("bayes_error", "robust_error"):
            return 10 * np.log10(value)
        return -value if self.wants_more else value

    def gain(self, reference: float, found: float) -> float:
        """How much better the goal `found` is than that of the reference, in the unit of `told`."""
        gain = float(self.told(reference) - self.told(found))
        return -gain if self.wants_more else gain

    def rise(self, value: float) -> float:
        """What is called worse by 1 %."""
        return _RISE_DB if self.name in ("worst_ratio", "unevenness") else RISE * abs(value)


class Problem(NamedTuple):
    """A search: `data` for the many evaluations, `exact` for the designs that were found."""

    goal: Goal
    space: DesignSpace
    data: Data
    exact: Data


def build_problem(config: DesignConfig) -> Problem:
    """In the precision that JAX is set to; looks at the photographs where the prior needs them."""
    setup = _setup(config)
    synthesis = jnp.asarray(synthesis_matrix(config.reference.method()), float)
    # The largest field of view reaches half of the pixels' Nyquist frequency 1/(2 pitch), which all
    # designs of the search can be compared up to.
    highest = jnp.asarray(config.farthest() / (4 * config.sensor.pitch))
    counts = config.search.frequencies
    return Problem(
        _goal(config),
        config.space(),
        Data(setup, synthesis, Polar(highest, counts.radii, counts.directions)),
        Data(setup, synthesis, Quadrant(highest, counts.exact or _exact_count(config, highest))),
    )


def _goal(config: DesignConfig) -> Goal:
    asked = config.search
    band, given = asked.band or DEFAULT_BAND, asked.tolerances
    if given is None:
        return Goal(asked.objective, band)
    return Goal(asked.objective, band, given.tolerances(), given.how)


def _exact_count(config: DesignConfig, highest) -> int:
    """Samples along an axis that resolve the fringes of |H|².

    As an angle, a PSF is as wide as the mask's shadow over its distance; |H|² holds differences of
    its points, up to that width to either side.
    """
    nearest = config.nearest()
    shadow = config.widest() * (1 + nearest / config.object.distance) / nearest
    return max(_FEWEST, math.ceil(_MARGIN * 2 * shadow * float(highest)) + 1)


def _setup(config: DesignConfig) -> Setup:
    return Setup(
        pitch=config.sensor.pitch,
        sensor_width=config.sensor.width,
        object_distance=config.object.distance,
        object_width=config.object.width,
        noise=_noise(config.noise),
        prior=_prior(config),
        contrast=config.prior.contrast,
        pixel_integration=config.pixel_integration,
    )


def _noise(noise: DesignNoiseConfig) -> SignalNoise | PhotonNoise:
    if noise.snr_db is not None:
        return SignalNoise(noise.snr_db)
    return PhotonNoise(noise.electrons or 0.0, noise.read_noise or 0.0)


def _prior(config: DesignConfig) -> PowerLaw:
    if config.prior.exponent is not None:
        return PowerLaw(config.prior.exponent)
    study = build_study(config)
    planes = (build_plane(study, target) for target in config.pictures())
    return fit_power_law(np.asarray(p.image, dtype=float).mean(axis=0) for p in planes)


def search_problem(problem: Problem, wanted: SearchConfig | ParetoConfig, seed: int) -> Search:
    """The search, as long as a section of the file wants it."""
    return find_designs(
        problem.goal,
        problem.space,
        problem.data,
        key=jax.random.key(seed),
        starts=wanted.starts,
        samples=wanted.samples,
        steps=wanted.steps,
        solver=wanted.solver,
    )


def broken_limits(config: DesignConfig) -> tuple[str, ...]:
    """Which limits of the search the reference itself does not keep, in words."""
    words = []
    limits = config.search.limits
    for number, shot in enumerate(config.reference.shots, 1):
        if limits.mask_pixel is not None:
            finest = math.pi / limits.mask_pixel / config.mask.width
            if shot.beta > finest * (1 + 1e-6):
                words.append(
                    f"β of shot {number}, {shot.beta:g} rad/mm², is more than the "
                    f"{finest:.4g} rad/mm² that mask pixels of {1000 * limits.mask_pixel:g} µm show"
                )
        if limits.thickness is not None and shot.distance > limits.thickness * (1 + 1e-6):
            words.append(
                f"the distance of shot {number}, {shot.distance:g} mm, is more than the thickness "
                f"of {limits.thickness:g} mm"
            )
    return tuple(words)
