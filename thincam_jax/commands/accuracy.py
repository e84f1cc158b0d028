"""The benchmark of accuracy: errors and times of all models, and what an error costs."""

from thincam_jax._core import checks
from thincam_jax._core.environment import machine
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import RunFolder, to_json
from thincam_jax.commands.sections import SensorConfig, StudyConfig
from thincam_jax.commands.study.build import build_study, check_optics
from thincam_jax.studies.evaluate import check_target
from thincam_jax.studies.psf_error_cost import AccuracyResult, AccuracyRun, make_case

_SIZES, _CAPTURE_SIZE = (128, 256, 512), 256  # by default


class BenchFolder(RunFolder):
    """`config.yaml` and `accuracy.json`, each written whole or not at all."""

    kind, folders, result, others = "benchmark", (), "accuracy.json", ()


def sizes_of_psfs(asked: tuple[int, ...], sensor: SensorConfig) -> tuple[int, ...]:
    """Sizes requested, else the default ones and the sensor's own; each once, smallest first."""
    own = max(sensor.shape)
    return tuple(sorted(set(asked or (*(s for s in _SIZES if s < own), own))))


def check(
    config: StudyConfig, sizes: tuple[int, ...] = (), capture_size: int | None = None
) -> AccuracyRun:
    """Refuse what cannot be run, before anything is; ConfigError, one line for each fault.

    - `sizes`: pixels along the sensor's longer side, for the PSFs; empty for the default ones.
    - `capture_size`: pixels along that side for captures and reconstructions; None for the default.
    """
    if config.mask.pixel_pitch is not None:
        fault = "mask.pixel_pitch: the models compared have no display pixels"
        raise ConfigError(f"{fault}; leave it out of the file")
    own = max(config.sensor.shape)
    of_captures = min(_CAPTURE_SIZE, own) if capture_size is None else capture_size
    try:
        for size in sizes:
            checks.whole("--size", size, 1, own)
        checks.whole("--capture-size", of_captures, 1, own)
    except ValueError as error:
        raise ConfigError(f"{error}, the pixels of the study's own sensor") from None
    study = build_study(config)
    case = make_case(study, of_captures)
    try:
        check_optics(case.study)
        check_target(case.study, case.target)
    except ValueError as error:
        raise ConfigError(f"--capture-size {of_captures}: {error}") from None
    return AccuracyRun(study, sizes_of_psfs(sizes, config.sensor), case)


def run_accuracy(plan: AccuracyRun, folder: BenchFolder, progress: Progress) -> AccuracyResult:
    """Run the benchmark into a folder."""
    folder.claim(plan.study.config)
    head = {"bench": "accuracy", "config": dump_config(plan.study.config), "machine": machine()}
    write = lambda: folder.write(folder.result, to_json(head | plan.record()))  # noqa: E731
    carry_out([*plan.work, Step("results", write)], progress)
    return plan.result
