"""A study of a second that the run, report and command tests share.

48×64 pixels of 40 µm (Nyquist 12.5 cycles/mm), a mask of 2 mm whose zones end at βR/π = 8.0
cycles/mm, an object of 80 mm at 100 mm that fills 60 of the 64 columns at d = 3.0 mm.
"""

from pathlib import Path

import skimage.io
from studies.tiny import picture

from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.sections import StudyConfig
from thincam_jax.commands.study.build import build_study
from thincam_jax.studies.study import Study

TEXT = """\
name: tiny
title: A tiny study
seed: 3
wavelength: 500 nm
model: geometric  # it compiles fastest
pixel_integration: false
sensor: {shape: [48, 64], pitch: 40 um}
mask: {width: 2 mm}
object: {distance: 100 mm, width: 80 mm}
noise: {snr_db: 30, signal_power: without_mean}
methods:
  - name: conventional
    kind: fringe_scanning
    shots:
      - {beta: 25 rad/mm^2, distance: 3 mm}
    published: {psnr_db: 20.3, resolved: 4.6 mm, limit_cycles_per_mm: 10.8}
  - name: pairs
    kind: wiener
    synthesis: phase_pairs
    shots:
      - {beta: 25 rad/mm^2, distance: 3 mm}
      - {beta: 21 rad/mm^2, distance: 3 mm}
targets:
  - {name: chart, kind: usaf1951, pixels: 120}
  - {name: picture, kind: file, path: PICTURE, linear: true}
"""

# Phases 0, π/2, π, 3π/2 at β = 25, of which the pairs use two, and two more at β = 21.
CAPTURES = 6


def write(folder: Path, text: str = TEXT) -> Path:
    """The study's file and its picture in a folder."""
    image = folder / "picture.png"
    if not image.exists():
        skimage.io.imsave(image, picture(), check_contrast=False)
    path = folder / "tiny.yaml"
    path.write_text(text.replace("PICTURE", str(image)), encoding="utf-8")
    return path


def study(folder: Path, *overrides: str, text: str = TEXT) -> StudyConfig:
    return load_experiment(write(folder, text), overrides)


def built(folder: Path, *overrides: str, text: str = TEXT) -> Study:
    return build_study(study(folder, *overrides, text=text))


def ignore(*_) -> None:
    """Progress that nobody watches."""


class Told(list[str]):
    """The texts of a run's progress, each of which was told the number of all."""

    def __call__(self, text: str, total: int) -> None:
        self.append(text)
        self.total = total
