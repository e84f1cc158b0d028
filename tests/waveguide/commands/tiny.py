"""A screen experiment of seconds: ERRATA's plate, 8×16 cells, 22×30 large pixels, calibrated."""

from pathlib import Path

from thincam_jax.commands.kinds import load_experiment

TEXT = """\
name: tiny-screen
kind: screen
seed: 1
hologram:
  wavelength: 532 nm
  reference_angle: 61.2 deg
  thickness: 16 um
  index_modulation: 0.02
screen:
  glass_thickness: 5 mm
  bottom: {width: 400 mm, height: 50 mm, y: 25 mm}
lens: {focal_distance: 6 mm, lens_distance: 10 mm}
sensor: {shape: [22, 30], pitch: 70.4 um}
object: {cells: [8, 16], distance: 550 mm, width: 120 mm, y: 27 mm}
orders: 3
band_samples: 3
noise: {snr_db: 40}
methods:
  - {name: CGM, kind: ridge}
  - {name: smooth, kind: ridge, ridge: 3}
models:
  - {name: right}
  - {name: convolution, mistake: shift_invariant}
  - {name: single, mistake: no_ghosts, glass_thickness: 5.2 mm}
calibration:
  bits: 10
  offset: 20
  noise_std: 1
  glass_thickness: 5.3 mm
  fitted: [glass_thickness]
  distances: [450 mm]
targets:
  - name: star
    kind: siemens_star
    pixels: 40
    binary: true
    published: {CGM: {psnr_db: 16.8, seconds: 72.6}}
  - {name: camera, kind: photograph, image: camera, crop: 0.6}
notes:
  - A note <b>of its own</b>.
"""


def write(folder: Path, text: str = TEXT) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def experiment(folder: Path, *overrides: str, text: str = TEXT):
    return load_experiment(write(folder, text), overrides)
