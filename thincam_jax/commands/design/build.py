"""From a design's file to its search problem and its training."""

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax.commands.design.config import DesignConfig, DesignNoiseConfig, SearchConfig
from thincam_jax.commands.design.config_pareto import ParetoConfig, with_shots
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.design import (
    AbstractObjective,
    BayesError,
    Design,
    DesignProblem,
    DesignSpace,
    FrequencyCounts,
    PhotonNoise,
    PowerLaw,
    ResolutionLimit,
    RobustError,
    SearchSettings,
    Setup,
    SignalNoise,
    Training,
    TrainingError,
    Unevenness,
    WorstRatio,
    build_training,
    design_problem,
    fit_power_law,
    training_pixels,
)
from thincam_jax.design.objectives import OBJECTIVES
from thincam_jax.imaging.targets import sample_image
from thincam_jax.studies.study import synthesis_matrix


def build_problem(study: FileStudy) -> DesignProblem:
    """In the precision that JAX is set to; looks at the photographs where the prior needs them."""
    config: DesignConfig = study.config
    space, counts = config.space(), FrequencyCounts(**dict(config.search.frequencies))
    synthesis = synthesis_of(space.base, config)
    return design_problem(build_objective(config.search), space, _setup(study), synthesis, counts)


def build_objective(asked: SearchConfig) -> AbstractObjective:
    """The objective that a file names."""
    if asked.tolerances is not None:
        return RobustError(asked.tolerances.build(), asked.tolerances.how)
    kind = OBJECTIVES[asked.objective]
    if asked.band is not None and issubclass(kind, WorstRatio | Unevenness):
        return kind(asked.band)
    return kind()


def synthesis_of(design: Design, config: DesignConfig) -> np.ndarray:
    """Of a design's captures, real weights (channel, capture)."""
    phases = design.phases
    return synthesis_matrix(config.reference.synthesis, design.captures // phases, phases)


def search_settings(asked: SearchConfig | ParetoConfig) -> SearchSettings:
    """How long a section of the file searches."""
    return SearchSettings(asked.starts, asked.samples, asked.steps, asked.solver)


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


def front_problems(
    config: DesignConfig, problem: DesignProblem, name: str, costs: list[float]
) -> dict[float, DesignProblem]:
    """The problem at each cost of a front: "thickness", "captures" or "light"."""
    if name == "captures":
        return {cost: _of_captures(config, problem, round(cost)) for cost in costs}
    given = DesignProblem(ResolutionLimit(), problem.space, problem.data, problem.exact)
    change = given.with_thickness if name == "thickness" else given.with_electrons
    return {cost: change(cost) for cost in costs}


def _of_captures(config: DesignConfig, problem: DesignProblem, captures: int) -> DesignProblem:
    space: DesignSpace = with_shots(config, captures // len(config.reference.phases)).space()
    matrix = jnp.asarray(synthesis_of(space.base, config), float)
    given = DesignProblem(BayesError(), problem.space, problem.data, problem.exact)
    return given.with_captures(space, matrix)


def training_problem(config: DesignConfig, problem: DesignProblem) -> DesignProblem:
    """What `train` of a file asks for, in the precision that JAX is set to.

    `problem`: of the search, in double precision; noise is of the file's seed.
    """
    asked, space = config.train, config.space()
    assert asked is not None  # for the type checker
    reached, setup = problem.space, problem.data.setup
    training: Training = build_training(
        [sample_image(name) for name in asked.images],
        reached,
        setup,
        synthesis_of(space.base, config),
        pixels=asked.pixels or training_pixels(reached, setup, config.sensor.shape),
        key=jax.random.key(config.seed),
    )
    return DesignProblem(TrainingError(asked.reconstruction), space, training)
