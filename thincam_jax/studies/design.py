"""Design of a camera: search, training, fronts, and simulation beside the designs to beat.

What is found by an objective of frequencies is simulated in full, for it knows neither the sensor's
border nor what a reconstruction makes of it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from thincam_jax._core.precision import allow, cast, decimal_value, precision_of
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax.design import SearchSettings, find_designs
from thincam_jax.design.design import Design
from thincam_jax.design.fronts import FrontPoint, FrontSearch, front_point, search_order
from thincam_jax.design.landscape import Landscape, landscape_if_any
from thincam_jax.design.least_error import Limit, limit
from thincam_jax.design.objectives import AbstractObjective, BayesError
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.ranking import (
    ModulationTransfer,
    RankedDesign,
    distinct_designs,
    found_name,
    modulation_transfer,
    rank_designs,
    rank_trained,
    score_design,
)
from thincam_jax.design.search import Found, Search, random_search
from thincam_jax.design.setup import PhotonNoise
from thincam_jax.design.training_search import (
    TrainedDesigns,
    TrainingDescents,
    TrainingError,
    TrainingSettings,
    build_training,
    training_pixels,
)
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.studies.study import Method, Study, Synthesis
from thincam_jax.studies.trials import HeldOut, further_photographs, hold_out, simulate_trials

RANDOM = "random search"

if TYPE_CHECKING:
    from thincam_jax.studies.design_result import DesignResult


@dataclass(frozen=True, eq=False)
class TrainingPlan:
    """Photographs that designs are trained on, and how.

    - `images`: by name, (y, x) or (y, x, channel); their middle squares are taken.
    - `pixels`: number of pixels of the sensor's shorter side; None: as many as the finest fringes
      need.
    - `denoiser`: denoiser of the reconstruction "pnp", such as `learn.Denoiser()`.
    """

    images: Mapping[str, np.ndarray]
    error: TrainingError = TrainingError()
    settings: TrainingSettings = TrainingSettings()
    pixels: int | None = None
    denoiser: Any = None

    def problem(
        self, searched: DesignProblem, sensor_shape: tuple[int, int], key: PRNGKeyArray
    ) -> DesignProblem:
        """The problem of the training, in the precision that JAX is set to."""
        space, setup = searched.space, searched.data.setup
        training = build_training(
            list(self.images.values()),
            space,
            setup,
            np.asarray(searched.data.synthesis, dtype=float),
            pixels=self.pixels or training_pixels(space, setup, sensor_shape),
            key=key,
        )
        if self.denoiser is not None:
            training = training.with_denoiser(self.denoiser)
        return DesignProblem(self.error, cast(space, precision_of(jnp.zeros(()))), training)


@dataclass(frozen=True, eq=False)
class FrontPlan:
    """Fronts of designs, and how long each of their points is searched for.

    - `problems`: by front, "thickness", "captures" or "light", and by rising cost.
    """

    problems: Mapping[str, Mapping[float, DesignProblem]]
    settings: SearchSettings = SearchSettings()


@dataclass(frozen=True, eq=False)
class DesignStudy:
    """A search for the best design, and its simulation beside the designs to beat.

    - `study`: study of the simulation: zone plate, sensor, noise, targets and seed; its methods are
      the designs given, see `of_designs`.
    - `problem`: problem of the search, its base the design to beat; in double precision, see
      `design_problem`.
    - `rivals`: the other designs given, by name.
    - `settings`: length of the search; `grid`: points along each side of the landscape.
    - `seeds`: number of seeds of the noise in the simulation; `best`: how many of the designs found
      it has.
    - `photographs`: number of further ones on which the best design meets the one to beat,
      none of them trained on; 0 for none.
    - `training`, `fronts`: None for none.
    """

    study: Study
    problem: DesignProblem
    rivals: Mapping[str, Design]
    settings: SearchSettings = SearchSettings()
    grid: int = 61
    seeds: int = 5
    best: int = 3
    training: TrainingPlan | None = None
    fronts: FrontPlan | None = None
    photographs: int = 12

    def __post_init__(self):
        if not isinstance(self.problem.objective, AbstractObjective):
            raise TypeError(
                f"the objective {self.problem.objective!r} has no unit to report; give an "
                "AbstractObjective, such as BayesError()"
            )

    @property
    def reference(self) -> str:
        """Name of the design to beat."""
        return self.study.methods[0].name

    @property
    def key(self) -> PRNGKeyArray:
        """Random key of the search, from the seed of the study."""
        return jax.random.key(self.study.seed)

    @property
    def warnings(self) -> list[str]:
        """Warnings before it runs."""
        return self.study.warnings

    def with_designs(self, designs: Mapping[str, Design]) -> Study:
        """The study with further designs, by name, as methods."""
        more = tuple(self.method(name, design) for name, design in designs.items())
        return replace(self.study, methods=self.study.methods + more)

    def simulated(self, found: "FoundDesigns") -> Study:
        """The designs given and the best of those found, as methods of a study."""
        return self.with_designs({one.name: one.design for one in found.found[: self.best]})

    def method(self, name: str, design: Design) -> Method:
        """A design as a method of the study, with synthesis and solver of the one to beat."""
        first = self.study.methods[0]
        return as_method(self.study.mask, name, design, first.synthesis, first.solver)

    def run(self, progress: Progress | None = None) -> "DesignResult":
        """Search, train, simulate and search for the fronts, all in memory."""
        from thincam_jax.studies.design_result import DesignResult

        search = DesignSearch(self)
        fronts = None if self.fronts is None else FrontSearches(self, self.fronts)
        carry_out([*search.work, *([] if fronts is None else fronts.work)], progress)
        study = self.simulated(search.result)
        trials = {
            target.name: simulate_trials(study, target, self.seeds) for target in study.targets
        }
        return DesignResult(
            self, search.result, trials, None if fronts is None else fronts.result()
        )


def as_method(
    mask: AbstractMask, name: str, design: Design, synthesis: Synthesis, solver: AbstractSolver
) -> Method:
    """A design as a method of a study whose masks are shown as `mask` is.

    On a display, a width other than that of `mask` is rounded down to whole pixels.
    """
    width = float(design.width)
    if isinstance(mask, FresnelZoneAperture) and mask.pixels is not None:
        whole = decimal_value(mask.width)
        if width != whole:
            pixel = whole / mask.pixels[1]
            width = max(1, math.floor(width / pixel + 1e-6)) * pixel
    exposures = Exposures(
        np.asarray(design.beta),
        np.asarray(design.distance),
        phase=np.asarray(design.phase),
        wavelength=np.asarray(design.wavelength),
        width=width,
        relative_time=np.asarray(design.exposure),
    )
    return Method(name, exposures, solver, synthesis, design.phases)


@dataclass(frozen=True, eq=False)
class FoundDesigns:
    """Result of a search.

    - `edge`: highest of the frequencies looked at, cycles/rad; `exponent`: exponent of the prior.
    - `transfers`: modulation transfer of the reference and of the best design.
    - `training`: the trained designs; None without training.
    - `random`: the best of `random_designs` random ones, at the cost of the search.
    - `held_out`: the best design and the random one on photographs not trained on.
    - `limits`: least errors of any masks, of the best linear image with noise that counts
      electrons; empty otherwise.
    """

    objective: AbstractObjective
    reference: RankedDesign
    found: tuple[RankedDesign, ...]
    evaluations: int
    failed: int
    exponent: float
    edge: float
    landscape: Landscape | None
    transfers: tuple[ModulationTransfer, ...] = ()
    training: TrainedDesigns | None = None
    random: RankedDesign | None = None
    random_designs: int = 0
    held_out: HeldOut | None = None
    limits: tuple[Limit, ...] = ()


class DesignSearch:
    """The search of a study in steps, which end with the `result`.

    - `searching`, `training`, `ranking`: the steps, one after the other.

    In double precision: the objective's fringes are finer than single holds. Training, which is not
    that fine, is in the precision that JAX is set to.

    **Errors**: NonFiniteObjectiveError where the objective is NaN at every start.
    """

    searched: Search
    kept: tuple[Found, ...]
    descents: TrainingDescents
    trained: TrainedDesigns | None = None
    found: tuple[RankedDesign, ...]
    random: RankedDesign
    sampled: int
    result: FoundDesigns

    def __init__(self, study: DesignStudy):
        self.study, self.problem = study, study.problem
        self.searching = [Step("search", self._search)]
        self.training: list[Step] = []
        if (plan := study.training) is not None:
            starts = plan.settings.starts
            self.training = [
                Step("training, samples", partial(self._sample, plan)),
                *(
                    Step(f"training {n + 1} of {starts}", partial(self._descend, n))
                    for n in range(starts)
                ),
                Step("around the trained designs", self._finish_training),
            ]
        self.ranking = [
            Step("found designs", self._rank),
            Step("random designs", self._compare),
            Step("landscape", self._surround),
            Step("further photographs", self._hold_out),
        ]

    @property
    def work(self) -> list[Step]:
        """All steps."""
        return [*self.searching, *self.training, *self.ranking]

    def _search(self) -> None:
        with allow("float64"):
            self.searched = find_designs(self.problem, self.study.settings, key=self.study.key)
            self.kept = distinct_designs(self.problem.space, self.searched.found)

    def _sample(self, plan: TrainingPlan) -> None:
        points = [np.asarray(one.point) for one in self.kept]
        key = self.study.key
        problem = plan.problem(self.problem, self.study.study.sensor.shape, key)
        self.descents = TrainingDescents(problem, points, plan.settings, key)

    def _descend(self, number: int) -> None:
        self.descents.descend(number)

    def _finish_training(self) -> None:
        self.trained = self.descents.finish()

    def _rank(self) -> None:
        with allow("float64"):
            if self.trained is None:
                self.found = rank_designs(self.problem, self.kept)
            else:
                self.found = rank_trained(self.problem, self.trained)

    def _compare(self) -> None:
        """Compare with the best of random designs at the same cost."""
        key = jax.random.fold_in(self.study.key, 1)
        with allow("float64"):
            design, self.sampled = random_search(
                self.problem, self.searched, self.study.settings, key=key
            )
            self.random = score_design(self.problem, design, RANDOM)

    def _hold_out(self) -> None:
        study, trained = self.study, self.study.training
        used = () if trained is None else trained.images
        names = further_photographs(used, study.photographs)
        if len(names) > 1 and study.study.targets:
            designs = {one.name: one.design for one in (self.found[0], self.random)}
            held_out = hold_out(study.with_designs(designs), names)
            self.result = replace(self.result, held_out=held_out)

    def _surround(self) -> None:
        problem, base, best = self.problem, self.problem.space.base, self.found[0].design
        with allow("float64"):
            reference = score_design(problem, base, self.study.reference)
            if self.trained is not None:
                reference = replace(reference, trained=self.trained.reference)
            assert isinstance(problem.objective, AbstractObjective)  # for the type checker
            self.result = FoundDesigns(
                problem.objective,
                reference,
                self.found,
                self.searched.evaluations,
                self.searched.failed,
                float(problem.data.setup.prior.exponent),
                float(problem.data.frequencies.highest),
                landscape_if_any(problem, best, self.study.grid),
                tuple(modulation_transfer(one, problem.exact) for one in (base, best)),
                self.trained,
                self.random,
                self.sampled,
                limits=_limits(problem),
            )


def _limits(problem: DesignProblem) -> tuple[Limit, ...]:
    counted = isinstance(problem.data.setup.noise, PhotonNoise)
    if not (counted and isinstance(problem.objective, BayesError)):
        return ()
    return limit(problem), limit(problem, masks="amplitude")


@dataclass(frozen=True, eq=False)
class Front:
    """The points of a front in the order of their cost, and the design to beat at its own."""

    points: tuple[FrontPoint, ...]
    reference: FrontPoint


@dataclass(frozen=True, eq=False)
class Fronts:
    """Fronts by their names: "thickness", "captures", "light".

    - `edge`: the highest frequency of all, cycles/rad.
    - `picture_variance`: geometric mean over the pictures, whose values end at 1; of captures.
    - `simulated`: PSNR of each picture, dB, of each point of captures.
    """

    fronts: dict[str, Front]
    edge: float
    picture_variance: float | None
    simulated: tuple[dict[str, float | None], ...] = ()


_FRONT_STEPS = {
    "thickness": "thickness {:.3g} mm",
    "captures": "{:g} captures",
    "light": "light {:.4g} electrons",
}


class FrontSearches:
    """The fronts of a study in steps, and what they result in.

    Captures share the reference's exposure time, and are simulated in full. In double precision, as
    in `DesignSearch`.

    **Errors**: NonFiniteObjectiveError where the objective is NaN at every start.
    """

    def __init__(self, study: DesignStudy, plan: FrontPlan):
        self.study = study
        self.searches = {
            name: FrontSearch(each, plan.settings, study.key)
            for name, each in plan.problems.items()
        }
        self.simulated: list[dict[str, float | None]] = []
        self.work: list[Step] = []
        for name, search in self.searches.items():
            for place, beside in search_order(
                len(search.costs), rising_captures=name == "captures"
            ):
                text = _FRONT_STEPS[name].format(search.costs[place])
                self.work.append(Step(text, partial(self._search, search, place, beside)))
        if "captures" in self.searches:
            for place, cost in enumerate(self.searches["captures"].costs):
                text = f"{cost:g} captures, simulated"
                self.work.append(Step(text, partial(self._simulate, place)))

    def _search(self, search: FrontSearch, place: int, beside: int | None) -> None:
        """A point of a front, near that of another place or over the whole space."""
        with allow("float64"):
            search.advance(place, beside)

    def _simulate(self, place: int) -> None:
        """PSNR of every picture in the full simulation, at the seed of the study."""
        name = found_name(1)
        method = self.study.method(name, self.searches["captures"].points[place].design)
        study = replace(self.study.study, methods=(method,))
        self.simulated.append(
            {
                target.name: simulate_trials(study, target, 1)[name][0].psnr_db
                for target in study.targets
                if target.is_picture
            }
        )

    def result(self) -> Fronts:
        """When all work is done."""
        problem, noise = self.study.problem, self.study.problem.data.setup.noise
        base = problem.space.base
        costs = {
            "thickness": max(shot.distance for shot in base.shots),
            "captures": float(base.captures),
            "light": float(noise.electrons) if isinstance(noise, PhotonNoise) else 0.0,
        }
        with allow("float64"):
            reference = front_point(base, problem.exact)
        fronts = {
            name: Front(search.points, replace(reference, cost=costs[name]))
            for name, search in self.searches.items()
        }
        variance = _variance(self.study.study) if "captures" in fronts else None
        return Fronts(
            fronts, float(problem.exact.frequencies.highest), variance, tuple(self.simulated)
        )


def _variance(study: Study) -> float:
    """Geometric mean over the pictures."""
    planes = (target.plane for target in study.targets if target.is_picture)
    images = (np.asarray(plane.image, dtype=float) for plane in planes)
    return float(np.exp(np.mean([np.log(np.mean(np.var(i, axis=(-2, -1)))) for i in images])))
