"""Files of kind design: what they mean, and one line for each fault."""

import numpy as np
import pytest
import skimage.io
from commands.design import tiny

from helpers import rows
from thincam_jax.commands.checked_config import dump_config, shortened
from thincam_jax.commands.config_file import ConfigError


def fault(folder, *overrides, text=tiny.TEXT):
    """The one line of the error, without the file's path."""
    with pytest.raises(ConfigError) as caught:
        tiny.design(folder, *overrides, text=text)
    (line,) = str(caught.value).splitlines()
    return line.removeprefix(f"{folder / 'tiny.yaml'}:")


def line_of(part):
    lines = tiny.TEXT.splitlines()
    (found,) = [n for n, line in enumerate(lines, 1) if part in line]
    return found


@pytest.mark.parametrize(
    ("entry", "captures"),
    [
        ("{variable: beta, bounds: [9 /mm^2, 20 /mm^2]}", [(0, 1), (2, 3)]),
        ("{variable: beta, bounds: [9 /mm^2, 20 /mm^2], shared: true}", [(0, 1, 2, 3)]),
        ("{variable: distance, bounds: [2 mm, 0.4 cm], shots: [2]}", [(2, 3)]),
    ],
)
def test_a_free_number_belongs_to_all_phases_of_its_shots(tmp_path, entry, captures):
    space = tiny.design(tmp_path, f"search.free=[{entry}]").space()
    assert [v.captures for v in space.variables] == captures
    lower, upper = (2.0, 4.0) if "distance" in entry else (9.0, 20.0)
    assert [(v.lower, v.upper) for v in space.variables] == [(lower, upper)] * len(captures)


def test_exposures_that_leave_nothing(tmp_path):
    noise = "noise={read_noise: 4, electrons: 900}"
    line = fault(tmp_path, "search.free=[{variable: exposure, bounds: [0.5, 1.5]}]", noise)
    assert ": search.free: " in line and "leave one that takes the rest, or free none" in line
    unknown = "search.free=[{variable: exposure, bounds: [0.2, 1.2], shots: [1, 3]}]"
    assert "the design has captures 1 to 4" in fault(tmp_path, unknown, noise)


def test_a_display_shows_no_finer_than_its_pixels(tmp_path):
    display = "mask.pixel_pitch=50 um"
    line = fault(tmp_path, display, "search.limits.mask_pixel=40 um")
    assert "search.limits.mask_pixel: 0.04 mm is finer than the display's pixels of 0.05" in line
    assert tiny.design(tmp_path, display, "search.limits.mask_pixel=50 um").mask.pixel_pitch == 0.05


def test_fringe_scanning_takes_four_captures_a_shot(tmp_path):
    config = tiny.design(
        tmp_path, "reference.synthesis=fringe_scanning", "search.limits.captures=8"
    )
    captures = [v.captures for v in config.space().variables]
    assert captures == [(0, 1, 2, 3), (4, 5, 6, 7)]


FAULTS = """
search.free.0.bounds=[9 /mm^2, 8 /mm^2] | search.free[0].bounds | bounds cross: 9 to 8
search.free.0={variable: width, bounds: [1 mm, 2 mm], shots: [1]} | search.free[0] | share the width
search.free.0={variable: exposure, bounds: [0.5, 1.5]} | search.free | noise that counts electrons
search.free.0={variable: exposure, bounds: [0.5 s, 1.5]} | search.free[0].bounds | give parts of
search.free.0={variable: wavelength, bounds: [5 um, 2 mm]} | search.free[0].bounds | 10 nm to 0.1 mm
reference.shots.1.beta=25 /mm^2 | reference.shots | hold an entry twice
reference.shots.1.wavelength=600 nm | reference.shots[1].wavelength | whole file
reference.shots.0.width=1 mm | reference.shots[0].width | whole file; drop this one
reference.name=Found 1 | reference.name | is what another or a found design is called
search.band=[0.1, 0.4] | search | objective bayes_error has no band
noise.read_noise=8 | noise | give either snr_db
prior.measured=true | prior | give either exponent
search.objective=robust_error | search | robust_error and tolerances belong together
search.tolerances={how: worst} | search.tolerances | give at least one, such as
train={images: [nobody]} | train.images | 'nobody' is no image; choose one of astronaut,
compare=[{name: pairs, shots: [SHOT, {beta: 8 /mm^2, distance: 3 mm}]}] | compare[0].name | another
pareto={} | pareto | no front is requested; give thickness, captures or light
FREE & pareto.thickness.bounds=[4 mm, 3 mm] | pareto.thickness.bounds | bounds cross: 4 to 3 mm
pareto.thickness.bounds=[3 mm, 4 mm] | pareto.thickness | no distance is free
FREE & pareto.thickness.bounds=[2 mm, 4 mm] | pareto.thickness.bounds | distance of capture 1 ≥ 3 mm
FREE & pareto.thickness.bounds=[3 mm, 5 mm] | pareto.thickness.bounds | no free distance beyond 4 mm
pareto.light.bounds=[9, 90] | pareto.light | light needs noise that counts electr
pareto.captures.shots=[1, 3] | pareto.captures.shots | 3 shots take 6 captures
search.free.0.shots=[2] & pareto.captures.shots=[1, 2] | pareto.captures.shots | nothing is free
CHART & pareto.captures.shots=[1] | pareto.captures | PSNR needs a photograph among the targets
CHART & prior={measured: true} | prior.measured | measured needs a photograph
search.objective=worst_ratio & search.band=[0.4, 0.1] | search | band 0.4 to 0.1 is too narrow
"""
FREE_DISTANCE = (
    "search.free=[{variable: beta, bounds: [12 /mm^2, 30 /mm^2]}, "
    "{variable: distance, bounds: [2 mm, 4 mm], shots: [2]}]"
)
WORDS = {
    "SHOT": "{beta: 9 /mm^2, distance: 3 mm}",
    "FREE": FREE_DISTANCE,
    "CHART": "targets=[{name: a, kind: usaf1951}]",
}


@pytest.mark.parametrize(("settings", "field", "part"), rows(FAULTS))
def test_fault(tmp_path, settings, field, part):
    for word, text in WORDS.items():
        settings = settings.replace(word, text)
    line = fault(tmp_path, *settings.split(" & "))
    assert f": {field}: " in line
    assert part in line


@pytest.mark.parametrize(
    ("setting", "place", "part"),
    [
        ("search.limits.mask_pixel=0.2 mm", "limits:", "show at most 7.854 rad/mm^2"),
        (
            "search.free=[{variable: beta, bounds: [8 /mm^2, 9 /mm^2]}, "
            "{variable: beta, bounds: [8 /mm^2, 9 /mm^2]}]",
            "free:",
            "is free twice",
        ),
        ("reference.synthesis=fringe_scanning", "limits:", "it takes 8 captures"),
    ],
)
def test_no_feasible_design(tmp_path, setting, place, part):
    """The two that conflict are named, at the entry of the file that they stand in."""
    line = fault(tmp_path, setting)
    field = place.rstrip(":")
    at = (f"{line_of(place)}: ", f"--set {shortened(setting)}: ")
    assert line.startswith(tuple(f"{a}search.{field}: " for a in at))
    assert part in line


def test_a_picture_too_small_to_measure(tmp_path):
    image = np.arange(20 * 40, dtype=np.uint8).reshape(20, 40)
    skimage.io.imsave(tmp_path / "small.png", image, check_contrast=False)
    with pytest.raises(ConfigError, match=r"targets\[1\]: 20×40 pixels are too few to measure a"):
        tiny.built(tmp_path, "prior={measured: true}", "targets.1.path=small.png")


def test_fronts_and_their_costs(tmp_path):
    fronts = tiny.design(
        tmp_path,
        FREE_DISTANCE,
        "noise={read_noise: 4, electrons: 900}",
        "pareto.thickness={bounds: [3 mm, 4 mm], points: 3}",
        "pareto.light={bounds: [10, 1000], points: 3}",
        "pareto.captures.shots=[2, 1]",
    )
    asked = fronts.pareto
    assert asked.thickness.costs() == pytest.approx([3.0, 3.5, 4.0])
    assert asked.light.costs() == pytest.approx([10, 100, 1000])
    assert asked.captures.shots == (1, 2)
    path = tmp_path / "again.yaml"
    path.write_text(dump_config(fronts), encoding="utf-8")
    assert tiny.load(path) == fronts
    assert tiny.design(tmp_path).pareto is None
