"""The benchmark of accuracy: errors and times of all models, and what an error costs."""

import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from thincam_jax._core.files import write_whole
from thincam_jax.commands.accuracy.cameras import Case, capture_size_of, make_case, sizes_of
from thincam_jax.commands.accuracy.captures import CaptureErrors
from thincam_jax.commands.accuracy.figures import draw
from thincam_jax.commands.accuracy.psfs import PsfErrors
from thincam_jax.commands.accuracy.reconstructions import ReconstructionErrors
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.doctor import usable_cores
from thincam_jax.commands.run_folder import Progress, Step, carry_out, claim_folder, to_json
from thincam_jax.commands.study.build import FileStudy, build_study
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.lensless.exposures import Exposure


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


@dataclass(frozen=True)
class Sizes:
    """What a user may choose.

    - `sizes`: pixels along the sensor's longer side, for the PSFs; empty for the default ones.
    - `capture_size`: the same for captures and reconstructions; None for the default.
    """

    sizes: tuple[int, ...] = ()
    capture_size: int | None = None


@dataclass(frozen=True)
class Benchmark:
    """A checked benchmark: the study, the sizes, and what is captured."""

    study: FileStudy
    sizes: tuple[int, ...]
    case: Case


def check(config: StudyConfig, options: Sizes) -> Benchmark:
    """Refuse what cannot be run, before anything is; ConfigError, one line for each fault."""
    if config.mask.pixel_pitch is not None:
        raise ConfigError(
            "mask.pixel_pitch: the benchmark compares models that have no display pixels; leave it "
            "out of the file"
        )
    sizes = sizes_of(config.sensor, options.sizes)
    capture_size = capture_size_of(config.sensor, options.capture_size)
    study = build_study(config)
    return Benchmark(study, sizes, make_case(study, capture_size))


def run_accuracy(plan: Benchmark, folder: BenchFolder, progress: Progress) -> dict[str, Any]:
    """Run the benchmark into a folder; returns what `accuracy.json` holds.

    The camera is that of the study's first exposure; the captures and reconstructions are of its
    first picture and first Wiener method.
    """
    study, exposure, results = plan.study, plan.study.exposures[0], {}
    folder.claim(study.config)
    psfs = [PsfErrors(study, exposure, size) for size in plan.sizes]
    captures, reconstructions = CaptureErrors(plan.case), ReconstructionErrors(plan.case)

    def report() -> None:
        results.update(
            bench="accuracy",
            config=dump_config(study.config),
            settings=_settings(plan),
            machine=_machine(),
            psfs=[row for errors in psfs for row in errors.rows],
            captures=captures.rows,
            reconstructions={
                "method": plan.case.method.name,
                "skipped": plan.case.skipped,
                "exact_psnr_db": reconstructions.exact_psnr_db,
                "models": reconstructions.models,
                "controlled": reconstructions.controlled,
            },
        )
        folder.finish(results, draw(results))

    work = [step for errors in (*psfs, captures, reconstructions) for step in errors.work]
    carry_out([*work, Step("figure", report)], progress)
    return results


def _settings(plan: Benchmark) -> dict[str, Any]:
    config = plan.study.config
    return {
        "study": config.name,
        "reference": "separable, float64",
        "sizes": list(plan.sizes),
        "camera": _numbers(plan.study.exposures[0]),
        "object_distance_mm": config.object.distance,
        "pixel_integration": config.pixel_integration,
        "capture_shape": list(plan.case.study.sensor.shape),
        "target": plan.case.target.name,
        "captured": _numbers(plan.case.method.exposures[0]),
    }


def _numbers(exposure: Exposure) -> dict[str, float]:
    return {
        "beta_rad_per_mm2": exposure.beta,
        "phase_rad": exposure.phase,
        "distance_mm": exposure.distance,
        "wavelength_mm": exposure.wavelength,
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
