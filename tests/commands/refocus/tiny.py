"""A refocus experiment of a few seconds: the small camera, two charts at 20 and 45 mm."""

from pathlib import Path

from thincam_jax.commands.kinds import load_experiment

TEXT = """\
name: tiny-refocus
kind: refocus
seed: 2
wavelength: 500 nm
model: geometric  # it compiles fastest
pixel_integration: false
sensor: {shape: [96, 112], pitch: 20 um}
mask: {width: 1.92 mm}
noise: {snr_db: 30, signal_power: without_mean}
objects:
  - {name: near, kind: siemens_star, pixels: 64, distance: 20 mm, width: 2.4 mm, x: -1.9 mm}
  - {name: far, kind: siemens_star, pixels: 64, distance: 45 mm, width: 5.4 mm, x: 4 mm, y: 0.4 mm}
sweep: {nearest: 15 mm, farthest: 90 mm, count: 13, method: wiener, window: 3}
methods:
  - name: conventional
    kind: fringe_scanning
    shots:
      - {beta: 80 rad/mm^2, distance: 5 mm}
  - name: wiener
    kind: wiener
    shots:
      - {beta: 80 rad/mm^2, distance: 5 mm}
notes:
  - A note <b>of its own</b>.
"""


def write(folder: Path, text: str = TEXT) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def experiment(folder: Path, *overrides: str, text: str = TEXT):
    return load_experiment(write(folder, text), overrides)
