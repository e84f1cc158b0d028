"""A design of some seconds that the tests share; the camera is that of `study.tiny`."""

from pathlib import Path

from commands.study import tiny

from thincam_jax.commands.design.build import build_design
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.design.design import Design
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.studies.design import DesignStudy

TEXT = """\
name: tiny design
kind: design
title: A tiny design
seed: 3
wavelength: 500 nm
model: geometric  # it compiles fastest
pixel_integration: false
sensor: {shape: [48, 64], pitch: 40 um}
mask: {width: 2 mm}
object: {distance: 100 mm, width: 80 mm}
noise: {snr_db: 30}
prior:
  exponent: 2.5
reference:
  name: pairs
  synthesis: phase_pairs
  shots:
    - {beta: 25 rad/mm^2, distance: 3 mm}
    - {beta: 21 rad/mm^2, distance: 3 mm}
search:
  free:
    - variable: beta
      bounds: [12 rad/mm^2, 30 rad/mm^2]
  limits:
    captures: 4
  starts: 4
  samples: 16
  steps: 8
  grid: 5
  frequencies: {radii: 64, directions: 1, exact: 64}
targets:
  - {name: chart, kind: usaf1951, pixels: 120}
  - {name: picture, kind: file, path: PICTURE, linear: true}
validate: {seeds: 2, best: 1, photographs: 3}
"""


def write(folder: Path, text: str = TEXT) -> Path:
    """The design's file and its picture in a folder."""
    return tiny.write(folder, text)


def load(path: Path, overrides: tuple[str, ...] = ()) -> DesignConfig:
    return load_experiment(path, overrides, "design")


def design(folder: Path, *overrides: str, text: str = TEXT) -> DesignConfig:
    return load(write(folder, text), overrides)


def built(folder: Path, *overrides: str, text: str = TEXT) -> DesignStudy:
    return build_design(design(folder, *overrides, text=text))


def found(betas, distances=3.0, width=2.0, **others) -> Design:
    """A design of so many shots with the two phases, and the wavelength of the file."""
    settings = Exposures(betas, distances, width=width, **({"wavelength": 5e-4} | others))
    return Design(settings.phase_pairs())


def ignore(*_) -> None:
    """Progress that nobody watches."""
