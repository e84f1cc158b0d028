"""What is searched for: the objective as a function of designs, and the numbers it takes."""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.commands.design.config import (
    DesignConfig,
    DesignNoiseConfig,
    ObjectiveName,
    SearchConfig,
)
from thincam_jax.commands.design.config_pareto import ParetoConfig
from thincam_jax.commands.study.build import FileStudy
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
from thincam_jax.studies.study import synthesis_matrix

DEFAULT_BAND = (0.05, 0.5)
# What is called worse by 1 %: 10 log10(1.01) dB for what is in dB.
RISE, _RISE_DB = 0.01, 0.0432

_MARGIN, _FEWEST = 1.1, 128  # of the samples that fringes need; at least


@dataclass(frozen=True, order=True)
class Shot:
    """β in rad/mm²; distance, wavelength and mask's width in mm; exposure in the reference's."""

    beta: float
    distance: float
    wavelength: float
    width: float
    exposure: float = 1.0


def phases_of(design: Design) -> int:
    """How many captures each shot takes: every shot takes the same, different phases."""
    return len(np.unique(np.asarray(design.phase)))


def shots_of_design(design: Design) -> tuple[Shot, ...]:
    """The numbers of each shot."""
    numbers = (getattr(design, field.name) for field in fields(Shot))
    each = np.broadcast_arrays(*(np.asarray(n, dtype=float) for n in numbers))
    rows = zip(*(n[:: phases_of(design)].tolist() for n in each), strict=True)
    return tuple(Shot(*row) for row in rows)


class ObjectiveData(eqx.Module):
    """What an objective takes beside the design."""

    setup: Setup
    synthesis: Float[Array, "channel capture"]
    frequencies: Frequencies


@dataclass(frozen=True)
class DesignObjective:
    """What is to be made small; equal objectives are compiled once.

    - `band`: of `worst_ratio` and `unevenness`.
    - `tolerances`, `how`: of `robust_error`.
    """

    name: ObjectiveName
    band: tuple[float, float] = DEFAULT_BAND
    tolerances: Tolerances = Tolerances()
    how: Literal["mean", "worst"] = "mean"

    def __call__(self, design: Design, data: Any) -> Float[Array, ""]:
        """What is made small: the negative of what is to be large."""
        value = self._value(design, data)
        return -value if self.wants_more else value

    def _value(self, design: Design, data: Any) -> Float[Array, ""]:
        if self.name == "robust_error":
            given = data.setup, data.synthesis, data.frequencies
            return robust_error(design, *given, self.tolerances, how=self.how)
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
    def has_band(self) -> bool:
        """Whether it looks at a band of frequencies only."""
        return self.name in ("worst_ratio", "unevenness")

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
        """A minimised value as it is shown: errors in dB, and what is to be large as it is."""
        value = np.asarray(minimised, dtype=float)
        if self.name in ("bayes_error", "robust_error"):
            return 10 * np.log10(value)
        return -value if self.wants_more else value

    def gain(self, reference: float, found: float) -> float:
        """How much better the value `found` is than the reference's, in the unit of `told`."""
        gain = float(self.told(reference) - self.told(found))
        return -gain if self.wants_more else gain

    def rise(self, value: float) -> float:
        """What is called worse by 1 %."""
        return _RISE_DB if self.has_band else RISE * abs(value)


class DesignProblem(eqx.Module):
    """A search: `data` for the many evaluations, `exact` for the designs that were found."""

    objective: DesignObjective
    space: DesignSpace
    data: ObjectiveData
    exact: ObjectiveData


def synthesis_of(design: Design, config: DesignConfig) -> np.ndarray:
    """Of a design's captures, real weights (channel, capture)."""
    phases = phases_of(design)
    return synthesis_matrix(config.reference.synthesis, design.captures // phases, phases)


def build_problem(study: FileStudy) -> DesignProblem:
    """In the precision that JAX is set to; looks at the photographs where the prior needs them."""
    config: DesignConfig = study.config
    setup, space = _setup(study), config.space()
    synthesis = jnp.asarray(synthesis_of(space.base, config), float)
    # The largest field of view reaches half of the pixels' Nyquist frequency 1/(2 pitch), which all
    # designs of the search can be compared up to.
    highest = jnp.asarray(config.reach("distance")[1] / (4 * config.sensor.pitch))
    counts = config.search.frequencies
    exact = Quadrant(highest, counts.exact or _exact_count(config, highest))
    return DesignProblem(
        _objective(config.search),
        space,
        ObjectiveData(setup, synthesis, Polar(highest, counts.radii, counts.directions)),
        ObjectiveData(setup, synthesis, exact),
    )


def _objective(asked: SearchConfig) -> DesignObjective:
    band, given = asked.band or DEFAULT_BAND, asked.tolerances
    if given is None:
        return DesignObjective(asked.objective, band)
    return DesignObjective(asked.objective, band, given.tolerances(), given.how)


def _exact_count(config: DesignConfig, highest) -> int:
    """Samples along an axis that resolve the fringes of |H|².

    As an angle, a PSF is as wide as the mask's shadow over its distance; |H|² holds differences of
    its points, up to that width to either side.
    """
    nearest, widest = config.reach("distance")[0], config.reach("width")[1]
    shadow = widest * (1 + nearest / config.object.distance) / nearest
    return max(_FEWEST, math.ceil(_MARGIN * 2 * shadow * float(highest)) + 1)


def _setup(study: FileStudy) -> Setup:
    config: DesignConfig = study.config
    return Setup(
        pitch=config.sensor.pitch,
        sensor_width=config.sensor.width,
        object_distance=config.object.distance,
        object_width=config.object.width,
        noise=_noise(config.noise),
        prior=_prior(study),
        contrast=config.prior.contrast,
        pixel_integration=config.pixel_integration,
    )


def _noise(noise: DesignNoiseConfig) -> SignalNoise | PhotonNoise:
    if noise.snr_db is not None:
        return SignalNoise(noise.snr_db)
    return PhotonNoise(noise.electrons or 0.0, noise.read_noise or 0.0)


def _prior(study: FileStudy) -> PowerLaw:
    if study.config.prior.exponent is not None:
        return PowerLaw(study.config.prior.exponent)
    planes = (target.plane for target in study.targets if target.is_picture)
    return fit_power_law(np.asarray(p.image, dtype=float).mean(axis=0) for p in planes)


def search_problem(
    problem: DesignProblem, wanted: SearchConfig | ParetoConfig, seed: int, exact: Any = None
) -> Search:
    """The search, as long as a section of the file wants it; improved where `exact` is given."""
    return find_designs(
        problem.objective,
        problem.space,
        problem.data,
        key=jax.random.key(seed),
        starts=wanted.starts,
        samples=wanted.samples,
        steps=wanted.steps,
        solver=wanted.solver,
        exact=exact,
    )
