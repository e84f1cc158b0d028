"""Rigs of seconds: pairs of phases on 64×96 pixels, and 8×16 Hadamard cells on 28×40."""

from pathlib import Path

METHOD_B = """\
name: tiny-rig
kind: capture
seed: 3
rig: virtual
camera: {driver: aravis, exposure: 20 ms, pitch: 33 um}
display: {driver: sdl, pitch: 36 um, settle: 2 ms}
plan:
  kind: method_b
  betas: [60 rad/mm^2, 50 rad/mm^2]
  width: 1.44 mm
  dark_frames: 2
optics:
  wavelength: 532 nm
  distance: 6.5 mm
  object: {distance: 250 mm, width: 60 mm}
virtual:
  sensor: [64, 96]
  display: [60, 80]
  electrons: 1_000_000
targets:
  - {name: coins, kind: photograph, image: coins}
"""

HADAMARD = """\
name: tiny-hadamard
kind: capture
seed: 3
rig: virtual
camera: {driver: aravis, exposure: 10 ms, pitch: 60 um}
display: {driver: sdl, pitch: 1 mm, settle: 1 ms}
plan: {kind: hadamard, cells: [8, 16], dark_frames: 2}
acquisition: {saturated: 0.1}
virtual:
  sensor: [28, 40]
  display: [30, 50]
  electrons: 1_000_000
  screen:
    hologram:
      wavelength: 532 nm
      reference_angle: 61.2 deg
      thickness: 16 um
      index_modulation: 0.02
    screen: {glass_thickness: 5 mm}
    lens: {focal_distance: 6 mm, lens_distance: 10 mm}
    sensor: {shape: [28, 40], pitch: 60 um}
    object: {cells: [8, 16], distance: 550 mm, width: 120 mm, y: 27 mm}
    orders: 3
"""
# A display behind the screen, a third as bright on the sensor as a white monitor.
DISPLAY_LIGHT = """\
    display_light:
      leak: [[400 nm, 0.03], [700 nm, 0.03]]
      primaries: [{centre: 530 nm, width: 60 nm}]
"""


def write(folder: Path, text: str = METHOD_B) -> Path:
    """The file of a capture in a folder."""
    path = folder / "capture.yaml"
    path.write_text(text, encoding="utf-8")
    return path
