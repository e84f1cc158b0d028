"""The benchmark of accuracy: errors and times of all models, and what an error costs."""

import platform
from pathlib import Path
from typing import Any, NamedTuple

import jax

from thincam_jax._core.files import write_whole
from thincam_jax.commands.accuracy.cameras import Case, capture_size_of, make_case, sizes_of
from thincam_jax.commands.accuracy.captures import capture_rows
from thincam_jax.commands.accuracy.figures import draw
from thincam_jax.commands.accuracy.psfs import Progress, candidate_count, psf_rows
from thincam_jax.commands.accuracy.reconstructions import (
    LEVELS,
    QUANTITIES,
    controlled_rows,
    make_experiment,
    model_rows,
)
from thincam_jax.commands.doctor import usable_cores
from thincam_jax.commands.run_folder import claim_folder, to_json
from thincam_jax.commands.study import build
from thincam_jax.commands.study.check import check_study
from thincam_jax.commands.study.config import ConfigError, StudyConfig, dump_config
from thincam_jax.lensless.method import MODELS


class BenchFolder:
    """`config.yaml`, `accuracy.json` and `accuracy.png`, each written whole or not at all."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def claim(self, config: StudyConfig) -> None:
        """Make the folder; ConfigError for one that holds anything but this configuration's."""
        claim_folder(self.path, "config.yaml", dump_config(config), "benchmark")

    def finish(self, results: dict[str, Any], figure: bytes) -> None:
        """Write both files; the table last, because it marks the benchmark as complete."""
        write_whole(self.path / "accuracy.png", figure)
        write_whole(self.path / "accuracy.json", to_json(results))


class Sizes(NamedTuple):
    """What a user may choose.

    - `sizes`: pixels along the sensor's longer side, for the PSFs; empty for the default ones.
    - `capture_size`: the same for captures and reconstructions; None for the default.
    """

    sizes: tuple[int, ...] = ()
    capture_size: int | None = None


class Benchmark(NamedTuple):
    """A checked benchmark: the sizes, and what is captured."""

    sizes: tuple[int, ...]
    capture_size: int
    case: Case


def check(config: StudyConfig, options: Sizes) -> Benchmark:
    """Refuse what cannot be run, before anything is; ConfigError, one line for each fault."""
    if config.mask.pixel_pitch is not None:
        raise ConfigError(
            "mask.pixel_pitch: the benchmark compares models that have no display pixels; leave it "
            "out of the file"
        )
    sizes = sizes_of(config, options.sizes)
    capture_size = capture_size_of(config, options.capture_size)
    check_study(config)
    return Benchmark(sizes, capture_size, make_case(config, capture_size))


def steps(config: StudyConfig, plan: Benchmark) -> int:
    """How many times `run_accuracy` reports progress."""
    candidates = len(plan.sizes) * candidate_count(config, build.all_settings(config)[0])
    controlled = 0 if plan.case.skipped else 1 + len(MODELS) + len(LEVELS) * len(QUANTITIES)
    return candidates + len(MODELS) + controlled + 1


def run_accuracy(
    config: StudyConfig, plan: Benchmark, folder: BenchFolder, progress: Progress
) -> dict[str, Any]:
    """Run the benchmark into a folder; returns what `accuracy.json` holds.

    The camera is that of the study's first exposure; the captures and reconstructions are of its
    first picture and first Wiener method.
    """
    folder.claim(config)
    setting = build.all_settings(config)[0]
    psfs = [row for size in plan.sizes for row in psf_rows(config, setting, size, progress)]
    captures = capture_rows(plan.case, progress)
    results = {
        "bench": "accuracy",
        "config": dump_config(config),
        "settings": _settings(config, plan, setting),
        "machine": _machine(),
        "psfs": psfs,
        "captures": captures,
        "reconstructions": _reconstructions(plan.case, progress),
    }
    progress("figure")
    folder.finish(results, draw(results))
    return results


def _settings(config: StudyConfig, plan: Benchmark, setting: build.Setting) -> dict[str, Any]:
    captured = plan.case.settings[0]
    return {
        "study": config.name,
        "reference": "separable, float64",
        "sizes": list(plan.sizes),
        "camera": _numbers(setting),
        "object_distance_mm": config.object.distance,
        "pixel_integration": config.pixel_integration,
        "capture_shape": list(plan.case.config.sensor.shape),
        "target": plan.case.target.name,
        "captured": _numbers(captured),
    }


def _numbers(setting: build.Setting) -> dict[str, float]:
    return {
        "beta_rad_per_mm2": setting.beta,
        "phase_rad": setting.phase,
        "distance_mm": setting.distance,
        "wavelength_mm": setting.wavelength,
    }


def _machine() -> dict[str, Any]:
    """What the times were measured on."""
    device = jax.devices()[0]
    return {
        "platform": f"{platform.system()} {platform.machine()}",
        "device_kind": device.device_kind,
        "device_platform": device.platform,
        "cores": usable_cores(),
        "jax": jax.__version__,
    }


def _reconstructions(case: Case, progress: Progress) -> dict[str, Any]:
    found: dict[str, Any] = {"method": case.method.name, "skipped": case.skipped}
    if case.skipped is not None:
        return found | {"exact_psnr_db": None, "models": [], "controlled": []}
    progress(f"captures for {case.method.name}")
    experiment = make_experiment(case)
    return found | {
        "exact_psnr_db": experiment.psnr_db,
        "models": model_rows(case, experiment, progress),
        "controlled": controlled_rows(case, experiment, progress),
    }
