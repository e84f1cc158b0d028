"""The benchmark of accuracy: errors and times of all models, and what an error costs."""

from collections.abc import Callable
from typing import Any, NamedTuple

from thincam_jax.commands.accuracy.captures import capture_rows
from thincam_jax.commands.accuracy.figures import draw
from thincam_jax.commands.accuracy.folder import BENCH, BenchFolder
from thincam_jax.commands.accuracy.machine import machine
from thincam_jax.commands.accuracy.perturb import LEVELS, QUANTITIES
from thincam_jax.commands.accuracy.psfs import psf_rows, way_count
from thincam_jax.commands.accuracy.reconstructions import (
    controlled_rows,
    make_experiment,
    model_rows,
)
from thincam_jax.commands.accuracy.rig import Rig, make_rig
from thincam_jax.commands.accuracy.sizes import capture_size_of, sizes_of
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.commands.study.study import Exposure, Study
from thincam_jax.lensless.psf import MODELS

Progress = Callable[[str], None]


class Options(NamedTuple):
    """What a user may choose.

    - `sizes`: pixels along the sensor's longer side, for the PSFs; empty for the default ones.
    - `capture_size`: the same for captures and reconstructions; None for the default.
    """

    sizes: tuple[int, ...] = ()
    capture_size: int | None = None


class Plan(NamedTuple):
    """A checked benchmark: the study, the sizes, and what is captured."""

    study: Study
    sizes: tuple[int, ...]
    capture_size: int
    rig: Rig


def check(config: StudyConfig, options: Options) -> Plan:
    """Refuse what cannot be run, before anything is; ConfigError, one line for each fault."""
    if config.mask.pixel_pitch is not None:
        raise ConfigError(
            "mask.pixel_pitch: the benchmark compares models that have no display pixels; leave it "
            "out of the file"
        )
    sizes = sizes_of(config.sensor, options.sizes)
    capture_size = capture_size_of(config.sensor, options.capture_size)
    study = build_study(config)
    return Plan(study, sizes, capture_size, make_rig(study, capture_size))


def steps(config: StudyConfig, plan: Plan) -> int:
    """How many times `run_accuracy` reports progress."""
    ways = len(plan.sizes) * way_count(plan.study, plan.study.exposures[0])
    controlled = 0 if plan.rig.skipped else 1 + len(MODELS) + len(LEVELS) * len(QUANTITIES)
    return ways + len(MODELS) + controlled + 1


def run_accuracy(
    config: StudyConfig, plan: Plan, folder: BenchFolder, progress: Progress
) -> dict[str, Any]:
    """Run the benchmark into a folder; returns what `accuracy.json` holds.

    The camera is that of the study's first exposure; the captures and reconstructions are of its
    first picture and first Wiener method.
    """
    folder.claim(dump_config(config))
    study, exposure = plan.study, plan.study.exposures[0]
    psfs = [row for size in plan.sizes for row in psf_rows(study, exposure, size, progress)]
    captures = capture_rows(plan.rig, progress)
    results = {
        "bench": BENCH,
        "config": dump_config(config),
        "settings": _settings(config, plan, exposure),
        "machine": machine(),
        "psfs": psfs,
        "captures": captures,
        "reconstructions": _reconstructions(plan.rig, progress),
    }
    progress("figure")
    folder.finish(results, draw(results))
    return results


def _settings(config: StudyConfig, plan: Plan, exposure: Exposure) -> dict[str, Any]:
    captured = plan.rig.exposures[0]
    return {
        "study": config.name,
        "reference": "separable, float64",
        "sizes": list(plan.sizes),
        "camera": _numbers(exposure),
        "object_distance_mm": config.object.distance,
        "pixel_integration": config.pixel_integration,
        "capture_shape": list(plan.rig.study.sensor.shape),
        "target": plan.rig.target.name,
        "captured": _numbers(captured),
    }


def _numbers(exposure: Exposure) -> dict[str, float]:
    return {
        "beta_rad_per_mm2": exposure.beta,
        "phase_rad": exposure.phase,
        "distance_mm": exposure.distance,
        "wavelength_mm": exposure.wavelength,
    }


def _reconstructions(rig: Rig, progress: Progress) -> dict[str, Any]:
    found: dict[str, Any] = {"method": rig.method.name, "skipped": rig.skipped}
    if rig.skipped is not None:
        return found | {"exact_psnr_db": None, "models": [], "controlled": []}
    progress(f"captures for {rig.method.name}")
    experiment = make_experiment(rig)
    return found | {
        "exact_psnr_db": experiment.psnr_db,
        "models": model_rows(rig, experiment, progress),
        "controlled": controlled_rows(rig, experiment, progress),
    }
