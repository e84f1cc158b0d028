"""A phase-only light modulator by the commands, on the virtual rig."""

import numpy as np
import PIL.Image
import pytest
import yaml
from commands.test_cli import call, one_line
from hardware.commands import tiny

from thincam_jax.commands.checked_config import load_as
from thincam_jax.hardware.commands.config import CaptureConfig
from thincam_jax.hardware.commands.run import picture_levels
from thincam_jax.hardware.displays.levels import PhaseLevels

PHASES = (0.0, 0.7, 2.8, 4.9, 5.65)
TABLE = {"phases": [f"{phase} rad" for phase in PHASES], "wavelength": "532 nm", "gap": 0.5}
FILE = yaml.safe_load(tiny.METHOD_B) | {
    "mask": {"family": "lenslets", "focal_length": "6.5 mm", "cell": "288 um", "lenses": [2, 2]},
    "plan": {"kind": "scene", "frames": 2, "dark_frames": 2},
}
FILE["display"] |= {"fill_factor": 0.9, "phase_levels": TABLE}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("phase"), yaml.safe_dump(FILE))


def loaded(file, *overrides):
    return load_as(CaptureConfig, file, overrides)


def test_phases_of_files(file, tmp_path):
    phase = np.random.default_rng(0).uniform(-9, 9, (16, 20))
    np.save(tmp_path / "phase.npy", phase)
    turn = np.rint(255 * np.mod(phase, 2 * np.pi) / (2 * np.pi)).astype(np.uint8)
    PIL.Image.fromarray(turn).save(tmp_path / "phase.png")
    shown = []
    for name in ("phase.npy", "phase.png"):
        mask = f"mask={{family: phase, path: {tmp_path / name}, width: 720 um}}"
        (levels,) = picture_levels(loaded(file, mask)).values()
        shown.append(PhaseLevels(PHASES, 532e-6).at(532e-6)[levels])
    assert np.abs(np.angle(np.exp(1j * (shown[0] - phase)))).max() < np.pi / 8
    assert np.abs(np.angle(np.exp(1j * (shown[0] - shown[1])))).mean() < 0.03


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("mask=null", "plan.width: optics need betas and width of the mask; give them"),
        ("display.phase_levels=null", "display.phase_levels: and 'mask' belong together"),
        ("display.phase_levels.phases=[1 rad]", "phase_levels.phases: 1 phases; give 2 to 256"),
        ("display.phase_levels=none.json", "none.json"),
        ("plan.betas=[60 rad/mm^2]", "mask: is of a scene or psf_stack with optics and without"),
        ("plan={kind: fringe_scan}", "plan.betas: a plan of kind fringe_scan needs it"),
        ("optics.wavelength=700 nm", "mask: the phase "),
        ("mask={family: pinhole, width: 720 um}", "mask: it turns no phase; give lenslets, "),
        ("mask.cell=300 um", "mask: height = 0.6 mm is not a whole number of cells of pitch"),
        ("mask={family: phase, path: none.npy, width: 720 um}", "none.npy"),
        ("virtual.display=[12, 80]", "mask: 16 × 16 cells do not fit into 12 × 80 pixels"),
    ],
)
def test_files_that_do_not_fit(file, asked, line, tmp_path):
    assert line in one_line(call("capture", file, "--out", tmp_path / "a.zarr", "--set", asked))
