"""A study of some ten milliseconds, once compiled, for sweeps of many points."""

import json
import os
import signal
from pathlib import Path

from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.sections import StudyConfig
from thincam_jax.commands.sweep.point import Axis, GridPoint, Metrics, make_points, read_axes

TEXT = """\
name: mini
wavelength: 500 nm
model: geometric  # it compiles fastest
pixel_integration: false
sensor: {shape: [32, 48], pitch: 60 um}
mask: {width: 2 mm}
object: {distance: 100 mm, width: 80 mm}
noise: {snr_db: 30}
methods:
  - name: single
    kind: wiener
    synthesis: separate
    shots: [{beta: 25 rad/mm^2, distance: 3 mm}]
targets:
  - {name: star, kind: siemens_star, pixels: 48}
"""


def write(folder: Path, text: str = TEXT) -> Path:
    path = folder / "mini.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def study(folder: Path, *overrides: str, text: str = TEXT) -> StudyConfig:
    return load_experiment(write(folder, text), overrides)


def axes(config: StudyConfig, *grid: str) -> list[Axis]:
    return read_axes(grid, config.model_dump(mode="json", exclude_none=True))


def points(config: StudyConfig, *grid: str, double: bool = False) -> list[GridPoint]:
    return make_points(config, axes(config, *grid), double)


def outcome(number: float) -> Metrics:
    """As of a point that was measured."""
    return Metrics({"psnr_db/single/star": float(number), "seconds": 0.5})


def ignore(ended: int, failed: int) -> None:
    """Progress that nobody watches."""


def deadly_measure(text: str, double: bool) -> Metrics:
    """In place of `measure_point`: seed 3 kills its worker, 4 raises."""
    seed = json.loads(text)["seed"]
    if seed == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 4:
        raise ZeroDivisionError("four")
    print("not a result")
    return outcome(seed)
