"""Designs in the full simulation, side by side, over the noise of several seeds."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Array

from thincam_jax._core.precision import allow
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.sections import MaskConfig, MethodConfig, MethodShotConfig, SensorConfig
from thincam_jax.commands.study import build
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.design import Design
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.reconstruction import Wiener
from thincam_jax.studies.evaluate import Evaluation, evaluate, field_shape, reconstructor
from thincam_jax.studies.simulate import expose, noise_free, stacked
from thincam_jax.studies.study import Method, Study, Target

# Electrons of a full well that no pixel fills: the search knows of no saturation.
_FULL_WELL = 1e9
_SMALLEST_PICTURE = 32  # pixels along a side from which a spectrum is measured
_STEPS = 6  # elements of a group of the USAF chart, which is an octave

Trials = dict[str, list[dict[str, Any]]]  # by method, the metrics of each seed


def build_designs(config: DesignConfig) -> FileStudy:
    """The designs that the file gives, as methods of a study, the one to beat first.

    **Errors**: ConfigError as of `build_study`, and for pictures too small for a measured prior.
    """
    with allow("float64"):
        given = {one.name: config.design(one) for one in (config.reference, *config.compare)}
    targets, unread = build.read_targets(
        config.targets, config.object.distance, config.object.width
    )
    methods = tuple(_method(config, name, design) for name, design in given.items())
    study = FileStudy(
        *build.build_optics(_mask(config), _sensor(config), methods[0].exposures[0]),
        methods,
        tuple(targets),
        object_distance=config.object.distance,
        noise=build.build_noise(config.noise.simulated()),
        model=config.model,
        pixel_integration=config.pixel_integration,
        seed=config.seed,
        name=config.name,
        config=config,
    )
    build.check_study(study, unread)
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
    """Of numbers that the design's file has had checked."""
    sensor = dict(config.sensor)
    if config.noise.electrons is not None:
        sensor |= {"full_well": _FULL_WELL, "electrons": config.noise.electrons}
    return SensorConfig.model_construct(**sensor)


def _mask(config: DesignConfig) -> MaskConfig:
    return MaskConfig.model_construct(**dict(config.mask))


def with_designs(study: FileStudy, designs: Mapping[str, Design]) -> FileStudy:
    """The study with further designs as methods, by name."""
    more = tuple(_method(study.config, name, design) for name, design in designs.items())
    return replace(study, methods=study.methods + more)


def _method(config: DesignConfig, name: str, design: Design) -> Method:
    width = float(design.width)
    pixel = config.mask.pixel_pitch
    if width != config.mask.width and pixel is not None:  # a display shows whole pixels
        width = max(1, math.floor(width / pixel + 1e-6)) * pixel
    exposures = Exposures(
        np.asarray(design.beta),
        np.asarray(design.distance),
        phase=np.asarray(design.phase),
        wavelength=np.asarray(design.wavelength),
        width=width,
        relative_time=np.asarray(design.exposure),
    )
    return Method(name, exposures, Wiener(), config.reference.synthesis, design.phases)


def as_study_config(study: FileStudy) -> StudyConfig:
    """The same designs for `thincam run`; what all shots share is left out of them.

    Nothing is checked again: its numbers were.
    """
    config: DesignConfig = study.config
    return StudyConfig.model_construct(
        name=f"{config.name} found"[:60],
        title=f"{config.title or config.name}: the designs found",
        seed=config.seed,
        wavelength=config.wavelength,
        model=config.model,
        pixel_integration=config.pixel_integration,
        sensor=_sensor(config),
        mask=_mask(config),
        object=config.object,
        noise=config.noise.simulated(),
        methods=tuple(_method_config(config, method) for method in study.methods),
        targets=config.targets,
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


def simulate(
    study: Study, target: Target, seeds: int, shown: dict[str, Evaluation] | None = None
) -> Trials:
    """Every method on one target; captures without noise are computed once.

    `shown` is given the reconstructions of the first seed. That is the study's own, so that
    `thincam run` gives the same.
    """
    clean: dict[Exposure, Array] = {}
    trials: Trials = {}
    for number, method in enumerate(study.methods):
        for exposure in method.exposures:
            if exposure not in clean:
                clean[exposure] = noise_free(study, exposure, target.plane)
        shape = field_shape(study, method, target)
        solve = reconstructor(study, method, shape, target.distance)
        trials[method.name] = []
        for trial in range(seeds):
            captures = [expose(study, e, clean[e], target.number, trial) for e in method.exposures]
            found = evaluate(method, target, solve(*stacked(captures)))
            trials[method.name].append(asdict(found.scores))
            if shown is not None:
                shown.setdefault(method.name, found)
        later = {exposure for m in study.methods[number + 1 :] for exposure in m.exposures}
        clean = {exposure: image for exposure, image in clean.items() if exposure in later}
    return trials


def compare(trials: Mapping[str, Trials]) -> dict[str, Any]:
    """For each method and target: PSNR and resolved element, and the gains over the first method.

    `trials` is by target. Means and standard deviations are over seeds; a gain is taken seed by
    seed. Resolution counts in elements of the chart, of which six halve the line pair.
    """
    reference, *others = next(iter(trials.values()))
    compared = {reference: {t: _spreads(tried[reference]) for t, tried in trials.items()}}
    for name in others:
        compared[name] = {
            target: _spreads(tried[name]) | _gains(tried[name], tried[reference])
            for target, tried in trials.items()
        }
    return compared


def _spreads(metrics: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "object_pixel_mm": metrics[0]["object_pixel_mm"],
        "psnr_db": _spread([m["psnr_db"] for m in metrics]),
        "ssim": _spread([m["ssim"] for m in metrics]),
        "resolved_object_mm": [m["resolved"] and m["resolved"]["object_mm"] for m in metrics],
    }


def _gains(metrics: list[dict[str, Any]], reference: list[dict[str, Any]]) -> dict[str, Any]:
    pairs = list(zip(metrics, reference, strict=True))
    steps = [[_step(m["resolved"]) for m in pair] for pair in pairs]
    return {
        "gain_db": _spread([_difference(a["psnr_db"], b["psnr_db"]) for a, b in pairs]),
        "gain_elements": _spread([_difference(a, b) for a, b in steps]),
    }


def _step(resolved: dict[str, Any] | None) -> int | None:
    return None if resolved is None else resolved["group"] * _STEPS + resolved["element"]


def _difference(one: float | int | None, other: float | int | None) -> float | int | None:
    return None if one is None or other is None else one - other


def _spread(values: list[Any]) -> dict[str, Any] | None:
    """Mean, standard deviation (n − 1; none of one seed) and the values; None if one is missing."""
    if None in values:
        return None
    return {
        "mean": round(float(np.mean(values)), 4),
        "deviation": round(float(np.std(values, ddof=1)), 4) if len(values) > 1 else None,
        "values": [round(float(v), 4) for v in values],
    }
