"""Study of a design's file, and a study's file of the designs found."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from thincam_jax._core.precision import allow
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design.config import DesignConfig, SearchConfig
from thincam_jax.commands.mask import MaskConfig
from thincam_jax.commands.sections import (
    MethodConfig,
    MethodShotConfig,
    SensorConfig,
    StudyConfig,
    build_solver,
)
from thincam_jax.commands.study import build
from thincam_jax.design import BayesError, PhotonNoise, PowerLaw, Setup, SignalNoise, design_problem
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import (
    OBJECTIVES,
    AbstractObjective,
    ResolutionLimit,
    RobustError,
    Unevenness,
    WorstRatio,
)
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.setup import fit_power_law
from thincam_jax.design.training_search import TrainingError, TrainingSettings
from thincam_jax.imaging.targets import sample_image
from thincam_jax.studies.design import DesignStudy, FrontPlan, TrainingPlan, as_method
from thincam_jax.studies.study import Method, Study, Target, synthesis_matrix

# Electrons of a full well that no pixel fills: the search knows of no saturation.
_FULL_WELL = 1e9
_SMALLEST_PICTURE = 32  # pixels along a side from which a spectrum is measured


def build_design(config: DesignConfig) -> DesignStudy:
    """All that a design needs, images read and everything checked, before the search.

    **Errors**: ConfigError as of `build_study`, and for pictures too small for a measured prior.
    """
    study = build_designs(config)
    with allow("float64"):
        problem = build_problem(config, study)
        rivals = {rival.name: config.design(rival) for rival in config.compare}
        fronts = _fronts(config, problem)
    search, validation = config.search, config.validation
    return DesignStudy(
        study,
        problem,
        rivals,
        search.build(),
        search.grid,
        validation.seeds,
        validation.best,
        _training(config),
        fronts,
        validation.photographs,
    )


def build_designs(config: DesignConfig) -> Study:
    """The designs that the file gives, as methods of a study, the one to beat first."""
    with allow("float64"):
        given = {one.name: config.design(one) for one in (config.reference, *config.compare)}

    def assembled() -> Study:
        sensor, first = _sensor(config), given[config.reference.name].exposures[0]
        drawn = MaskConfig.model_construct(**dict(config.mask))
        mask, sensor = build.build_optics(drawn, sensor, first)
        synthesis = config.reference.synthesis
        solver = build_solver(config.validation.reconstruction, None)
        return Study(
            mask,
            sensor,
            tuple(
                as_method(mask, name, design, synthesis, solver) for name, design in given.items()
            ),
            object_distance=config.object.distance,
            noise=config.noise.simulated().build(),
            model=config.model,
            pixel_integration=config.pixel_integration,
            seed=config.seed,
            name=config.name,
            config=config,
        )

    study = build.with_targets(config, assembled)
    for target in study.targets:
        rows, columns = target.plane.image.shape[-2:]
        if config.prior.measured and target.is_picture and min(rows, columns) < _SMALLEST_PICTURE:
            raise ConfigError(
                f"targets[{target.number}]: {rows}×{columns} pixels are too few to measure a "
                f"spectrum; give at least {_SMALLEST_PICTURE}×{_SMALLEST_PICTURE}, or "
                "prior.exponent"
            )
    return study


def _sensor(config: DesignConfig) -> SensorConfig:
    """Section of the sensor, of numbers that the design's file has had checked."""
    sensor = dict(config.sensor)
    if config.noise.electrons is not None:
        sensor |= {"full_well": _FULL_WELL, "electrons": config.noise.electrons}
    return SensorConfig.model_construct(**sensor)


def build_problem(config: DesignConfig, study: Study) -> DesignProblem:
    """Problem in JAX's precision; the photographs are looked at where the prior needs them."""
    space, counts = config.space(), config.search.frequencies.build()
    setup = Setup(
        pitch=config.sensor.pitch,
        sensor_width=min(config.sensor.shape) * config.sensor.pitch,
        object_distance=config.object.distance,
        object_width=config.object.width,
        noise=config.noise.build(PhotonNoise if config.noise.snr_db is None else SignalNoise),
        prior=_prior(config, study.targets),
        contrast=config.prior.contrast,
        pixel_integration=config.pixel_integration,
    )
    synthesis = _synthesis(config, space.base)
    return design_problem(build_objective(config.search), space, setup, synthesis, counts)


def build_objective(asked: SearchConfig) -> AbstractObjective:
    """The objective that a file names."""
    if asked.tolerances is not None:
        return RobustError(asked.tolerances.build(), asked.tolerances.how)
    kind = OBJECTIVES[asked.objective]
    if asked.band is not None and issubclass(kind, WorstRatio | Unevenness):
        return kind(asked.band)
    return kind()


def _synthesis(config: DesignConfig, design: Design) -> np.ndarray:
    """Real weights (channel, capture) of a design's captures."""
    phases = design.phases
    return synthesis_matrix(config.reference.synthesis, design.captures // phases, phases)


def _prior(config: DesignConfig, targets: tuple[Target, ...]) -> PowerLaw:
    if config.prior.exponent is not None:
        return PowerLaw(config.prior.exponent)
    planes = (target.plane for target in targets if target.is_picture)
    return fit_power_law(np.asarray(p.image, dtype=float).mean(axis=0) for p in planes)


def _training(config: DesignConfig) -> TrainingPlan | None:
    asked = config.train
    if asked is None:
        return None
    denoiser = None
    if asked.reconstruction == "pnp":
        from thincam_jax.learn import Denoiser  # here: others need not wait for the learned parts

        denoiser = Denoiser()
    return TrainingPlan(
        {name: sample_image(name, linear=True) for name in asked.images},
        TrainingError(asked.reconstruction),
        TrainingSettings(asked.samples, asked.starts, asked.steps, config.search.grid),
        asked.pixels,
        denoiser,
    )


def _fronts(config: DesignConfig, problem: DesignProblem) -> FrontPlan | None:
    asked = config.pareto
    if asked is None:
        return None
    costs = asked.costs(len(config.reference.phases))
    problems = {name: front_problems(config, problem, name, each) for name, each in costs.items()}
    return FrontPlan(problems, asked.build())


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
    space = with_shots(config, captures // len(config.reference.phases)).space()
    given = DesignProblem(BayesError(), problem.space, problem.data, problem.exact)
    return given.with_captures(space, _synthesis(config, space.base))


def with_shots(config: DesignConfig, count: int) -> DesignConfig:
    """File of this search for designs of so many shots.

    Fewer are the first of the reference; more of them begin as copies of its last, and are free in
    what that is free in.
    """
    given = config.reference.shots
    last = len(given)
    shots = (*given, *(given[-1],) * (count - last))[:count]
    free = []
    for entry in config.search.free:
        if entry.shots is None:
            free.append(entry)
            continue
        kept = tuple(s for s in entry.shots if s <= count)
        if last in entry.shots:
            kept = (*kept, *range(last + 1, count + 1))
        if kept:
            free.append(entry.model_copy(update={"shots": kept}))
    reference = config.reference.model_copy(update={"shots": shots})
    search = config.search.model_copy(update={"free": tuple(free)})
    return config.model_copy(update={"reference": reference, "search": search})


def as_study_config(config: DesignConfig, methods: tuple[Method, ...]) -> StudyConfig:
    """Designs for `thincam run`; what all shots share is left out of them.

    Nothing is checked again: its numbers were.
    """
    alike = "seed", "wavelength", "model", "pixel_integration", "object", "targets"
    return StudyConfig.model_construct(
        name=f"{config.name} found"[:60],
        title=f"{config.title or config.name}: the designs found",
        sensor=_sensor(config),
        mask=MaskConfig.model_construct(**dict(config.mask)),
        noise=config.noise.simulated(),
        methods=tuple(_method_config(config, method) for method in methods),
        **{name: getattr(config, name) for name in alike},
    )


def _method_config(config: DesignConfig, method: Method) -> MethodConfig:
    shots = tuple(
        MethodShotConfig.model_construct(
            beta=shot.beta,
            distance=shot.distance,
            wavelength=None if shot.wavelength == config.wavelength else shot.wavelength,
            width=None if shot.width == config.mask.width else shot.width,
            exposure=shot.relative_time,
            take=None if shot.take == 1 else shot.take,
        )
        for shot in method.shots
    )
    return MethodConfig.model_construct(
        name=method.name, kind=method.solver.name, synthesis=method.synthesis, shots=shots
    )


def search(asked: Any, setup: Any) -> Iterator[str]:
    """PSFs of the design to beat, and evaluations of a design's search."""
    asks, shots = asked.search, asked.reference.shots
    exposures = asked.design(asked.reference).exposures
    cameras = exposures.cameras(asked.sensor.build(), asked.mask.build(beta=1.0))
    words = (f"β {exposure.beta:g} rad/mm²" for exposure in exposures)
    found = list(zip(cameras, exposures, words, strict=True))
    yield from build.psf_costs(asked, found, asked.object.distance)
    finely = asks.frequencies
    most = asks.samples + asks.starts * asks.steps
    yield (
        f"search: {asks.samples} samples, {asks.starts} descents of at most {asks.steps} "
        f"steps: at most {most} evaluations and their gradients at {finely.radii}×"
        f"{finely.directions} frequencies of {len(shots)} shots"
    )
    again = asked.validation
    yield (
        f"validation: {again.best} found designs, the design to beat and {len(asked.compare)} "
        f"others, on {len(asked.targets)} targets, noise of {again.seeds} seeds"
    )
