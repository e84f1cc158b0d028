"""Experiment files: every fault is one line that names the place, the field and what is allowed."""

from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import rows
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.sections import PictureConfig, StudyConfig, TargetConfig
from thincam_jax.commands.study.build import read_picture
from thincam_jax.imaging.encoding import decode_srgb
from thincam_jax.imaging.targets import sample_image
from thincam_jax.studies.study import Target

BASE = """\
# A comment, so that the first key is not in the first line.
name: base
title: A study
seed: 7
wavelength: 500 nm
model: separable
sensor:
  shape: [48, 64]
  pitch: 40 um
  full_well: 13500
mask:
  width: 2 mm
  profile: cosine
object:
  distance: 100 mm
  width: 80 mm
noise:
  snr_db: 30
methods:
  - name: scan
    kind: fringe_scanning
    shots:
      - beta: 25 rad/mm^2
        distance: 3 mm
    published: {psnr_db: 20.3, resolved: 4.6 mm}
  - name: wiener
    kind: wiener
    synthesis: separate
    shots:
      - {beta: 25 rad/mm^2, distance: 3 mm}
      - {beta: 21 rad/mm^2, distance: 3 mm}
    phases: [0 rad, 270 deg]
targets:
  - name: chart
    kind: usaf1951
  - name: picture
    kind: photograph
    image: coffee
"""

ONE_SHOT = """synthesis: harmonics
    harmonics: [1, 4]
    shots:
      - {beta: 25 rad/mm^2, distance: 3 mm}
"""


def load(folder, text, *overrides):
    path = folder / "study.yaml"
    path.write_text(text, encoding="utf-8")
    return load_experiment(path, overrides)


def faults(folder, text, *overrides):
    """The lines of the error, with the file's path taken off: "LINE: FIELD: MESSAGE"."""
    with pytest.raises(ConfigError) as caught:
        load(folder, text, *overrides)
    return [
        line.removeprefix(f"{folder / 'study.yaml'}:") for line in str(caught.value).split("\n")
    ]


def line_of(text, part):
    """The number of the one line that is a text, or else that holds it."""
    lines = text.split("\n")
    found = [n for n, line in enumerate(lines, 1) if part == line]
    found = found or [n for n, line in enumerate(lines, 1) if part in line]
    assert len(found) == 1, (part, found)
    return found[0]


def changed(old, new, base=BASE):
    assert base.count(old) == 1, old
    return base.replace(old, new)


# Texts of the file, what they are changed to ("⏎" begins a line), the field and its message.
FAULTS = """
image: coffee | image: coffe | targets[1] | image 'coffe' is unknown; choose one of astronaut
[0 rad, 270 deg] | [0 rad, 0 deg] | methods[1].phases | phases hold an entry twice
wavelength: 500 nm | wavelength: 500 m | wavelength | is no wavelength of light; give 10 nm to 0.1
noise:⏎  snr_db: 30 | noise: | methods[1].kind | wiener weighs noise against signal; give a 'noise'
separate | fringe_scanning | methods[1] | fringe_scanning sets the phases itself; drop 'phases'
separate | separate⏎    harmonics: [1] | methods[1].harmonics | synthesis separate has none; drop it
kind: fringe_scanning | kind: fringe_scanning⏎    synthesis: separate | methods[0] | takes one shot
image: coffee | path: coffee.png | targets[1] | kind photograph needs 'image'
usaf1951 | usaf1951⏎    image: coffee | targets[0] | kind usaf1951 takes no 'image'
name: wiener | name:  scan | methods[1].name | 'scan' and 'scan' of methods[0]
name: picture | name: Chart. | targets[1].name | of targets[0] give the same file name 'chart'
snr_db: 30 | snr_db: 30⏎  read_noise: 2 | noise | give either snr_db
snr_db: 30 | read_noise: 0 | noise.read_noise | give sensor.exposure
{beta: 21 rad/mm^2, | {exposure: 2, beta: 21 /mm^2, | methods[1].shots[1].exposure | to the sensor's
full_well: 13500 | exposure: 0.9⏎  electrons: 2000 | sensor.electrons | exposed; give one
full_well: 13500 | bit_depth: 8 | sensor.bit_depth | needs an exposure, such as 0.9
profile: cosine | fill_factor: 0.9 | mask.fill_factor | give their pixel_pitch, too
"""


@pytest.mark.parametrize(("old", "new", "field", "part"), rows(FAULTS))
def test_fault(old, new, field, part, tmp_path):
    (line,) = faults(tmp_path, changed(old.replace("⏎", "\n"), new.replace("⏎", "\n")))
    assert f": {field}: " in line and part in line


def test_harmonics_that_so_few_phases_cannot_tell(tmp_path):
    old = BASE[BASE.index("synthesis: separate") : BASE.index("targets:")]
    (line,) = faults(tmp_path, changed(old, ONE_SHOT))
    assert "methods[1].harmonics: " in line
    assert "8 steps tell 1 to 3 apart; give some of them, each once" in line


def test_every_fault_has_its_own_line(tmp_path):
    text = changed("pitch: 40 um", "pitch: 40")
    text = changed("width: 2 mm", "width: -2 mm", text)
    text = changed("kind: usaf1951", "kind: chart", text)
    lines = faults(tmp_path, text)
    starts = [line.split(": ")[:2] for line in lines]
    assert starts == [
        [str(line_of(text, "pitch: 40")), "sensor.pitch"],
        [str(line_of(text, "width: -2 mm")), "mask.width"],
        [str(line_of(text, "kind: chart")), "targets[0].kind"],
    ]


CURVATURES = st.floats(1e-7, 1e7)
WAVELENGTHS, PITCHES = st.floats(1e-4, 0.1), st.floats(1e-4, 1.0)


@pytest.mark.thorough
@settings(max_examples=12, deadline=None)
@given(
    WAVELENGTHS,
    PITCHES,
    CURVATURES,
    st.floats(-100, 100),
    st.text("aÄ#:'\"\\{[ \n%-", max_size=150),
)
def test_dump_round_trips_to_the_last_bit(tmp_path_factory, wavelength, pitch, beta, phase, note):
    folder = tmp_path_factory.mktemp("dump")
    raw = load(folder, BASE).model_dump(mode="json", exclude_none=True)
    raw["wavelength"], raw["sensor"]["pitch"] = f"{wavelength!r} mm", f"{pitch!r} mm"
    raw["methods"][1]["shots"][0]["beta"] = f"{beta!r} rad/mm^2"
    raw["methods"][1]["phases"] = [f"{phase!r} rad"]
    raw["title"], raw["notes"] = note, [note]
    config = StudyConfig.model_validate(raw)
    text = dump_config(config)
    again = load(folder, text)
    assert again == config
    assert (again.wavelength, again.sensor.pitch) == (wavelength, pitch)
    assert dump_config(again) == text


def test_pictures_are_light_and_pages_show_their_codes(tmp_path):
    """A file is decoded, scikit-image's photographs and the levels of cells are not."""
    codes = np.random.default_rng(0).integers(0, 256, (9, 14), dtype=np.uint8)
    PIL.Image.fromarray(codes).save(tmp_path / "a.png")
    picture = {"name": "a", "kind": "file", "path": str(tmp_path / "a.png")}
    light = read_picture(TargetConfig(**picture))
    np.testing.assert_allclose(light, decode_srgb(codes / 255))
    for config in (TargetConfig(**picture, linear=True), PictureConfig(**picture)):
        np.testing.assert_allclose(read_picture(config), codes / 255)
    np.testing.assert_allclose(read_picture(PictureConfig(**picture, linear=False)), light)
    photograph = {"name": "a", "kind": "photograph", "image": "coins"}
    known = sample_image("coins", linear=True)
    np.testing.assert_array_equal(read_picture(TargetConfig(**photograph)), known)
    decoded = sample_image("coins")
    np.testing.assert_array_equal(read_picture(TargetConfig(**photograph, linear=False)), decoded)
    target = Target.of_image("a", light, 100.0, 20.0)
    np.testing.assert_allclose(target.shown(light), codes / 255, atol=1e-6)
    assert replace(target, kind="photograph").shown(light) is light
