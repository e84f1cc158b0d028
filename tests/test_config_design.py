"""Files of kind design: what they mean, and one line for each fault."""

import pytest
from design_run import tiny

from helpers import ROOT
from thincam_jax.config import ConfigError, dump_config
from thincam_jax.config_design import load_design
from thincam_jax.config_refocus import load_experiment
from thincam_jax.design_run import broken_limits


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


def test_values_and_defaults(tmp_path):
    config = tiny.design(tmp_path)
    assert config.sensor.width == pytest.approx(48 * 0.04)
    assert config.search.free[0].bounds == (12.0, 30.0)
    assert config.search.objective == "bayes_error"
    assert config.validation.best == 2
    assert config.farthest() == 3.0
    without = tiny.TEXT.replace("prior:\n  exponent: 2.5\n", "")
    assert tiny.design(tmp_path, text=without).prior.measured


def test_resolved_file_is_read_back(tmp_path):
    config = tiny.design(tmp_path, "search.objective=unevenness", "search.band=[0.1, 0.4]")
    path = tmp_path / "again.yaml"
    path.write_text(dump_config(config), encoding="utf-8")
    assert "validate:\n" in dump_config(config)
    assert load_design(path) == config


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


def test_fringe_scanning_takes_four_captures_a_shot(tmp_path):
    config = tiny.design(
        tmp_path, "reference.synthesis=fringe_scanning", "search.limits.captures=8"
    )
    captures = [v.captures for v in config.space().variables]
    assert captures == [(0, 1, 2, 3), (4, 5, 6, 7)]


def test_the_farthest_distance_keeps_the_thickness(tmp_path):
    free = "search.free=[{variable: distance, bounds: [2 mm, 9 mm]}]"
    assert tiny.design(tmp_path, free).farthest() == 9.0
    assert tiny.design(tmp_path, free, "search.limits.thickness=5 mm").farthest() == 5.0
    assert tiny.design(tmp_path, free, "search.limits.thickness=2.5 mm").farthest() == 3.0


@pytest.mark.parametrize(
    ("setting", "field", "part"),
    [
        (
            "search.free.0.bounds=[9 /mm^2, 8 /mm^2]",
            "search.free[0].bounds",
            "bounds cross: 9 to 8",
        ),
        (
            "search.free.0.bounds=[9 /mm^2, 9 /mm^2]",
            "search.free[0].bounds",
            "bounds cross: 9 to 9",
        ),
        ("search.free.0.bounds=[0 /mm^2, 9 /mm^2]", "search.free[0].bounds", "above zero"),
        ("search.free.0.bounds=[8 mm, 9 mm]", "search.free[0].bounds", "is a length, not a curv"),
        ("search.free.0.bounds=[8, 9]", "search.free[0].bounds", "8 has no unit"),
        ("search.free.0.bounds=8 /mm^2", "search.free[0].bounds", "give [lowest, highest]"),
        ("search.free.0.variable=width", "search.free[0].variable", "'beta' or 'distance'"),
        ("search.free.0.colour=1", "search.free[0].colour", "variable, bounds, shared, shots"),
        ("search.free=[]", "search.free", "give at least 1"),
        ("search.starts=0", "search.starts", "greater than or equal to 1"),
        ("search.limits.captures=0", "search.limits.captures", "greater than or equal to 1"),
        ("reference.shots=[]", "reference.shots", "give at least 1"),
        ("reference.shots.1.beta=25 /mm^2", "reference.shots", "hold an entry twice"),
        ("reference.shots.1.wavelength=600 nm", "reference.shots[1].wavelength", "one wavelength"),
        ("reference.name=Found 2", "reference.name", "is what found designs are called"),
        ("search.band=[0.1, 0.4]", "search", "objective bayes_error has no band"),
        ("validate.seeds=0", "validate.seeds", "greater than or equal to 1"),
        ("validate.runs=1", "validate.runs", "unknown key; allowed here: seeds, best"),
        ("validation.seeds=1", "validation", "unknown key; allowed here: name, kind,"),
        ("noise.read_noise=8", "noise", "give either snr_db"),
        ("prior.measured=true", "prior", "give either exponent"),
        ("targets=[]", "targets", "give at least 1"),
    ],
)
def test_fault_of_an_entry(tmp_path, setting, field, part):
    line = fault(tmp_path, setting)
    assert f": {field}: " in line
    assert part in line


@pytest.mark.parametrize(
    ("setting", "place", "part"),
    [
        ("search.limits.captures=2", "limits:", "it takes 4 captures, and the budget is 2"),
        ("search.limits.thickness=2.9 mm", "limits:", "distance of capture 1 ≥ 3 mm conflicts"),
        ("search.limits.mask_pixel=0.2 mm", "limits:", "show at most 7.854 rad/mm^2"),
        ("search.free.0.shots=[3]", "free:", "the design has captures 1 to 4"),
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
    at = (f"{line_of(place)}: ", f"--set {setting}: ")
    assert line.startswith(tuple(f"{a}search.{field}: " for a in at))
    assert part in line


def test_more_captures_than_a_design_may_have(tmp_path):
    shots = ", ".join(f"{{beta: {b} /mm^2, distance: 3 mm}}" for b in range(20, 25))
    assert "give 1 to 8" in fault(tmp_path, f"reference.shots=[{shots}]")


def test_too_narrow_a_band(tmp_path):
    line = fault(tmp_path, "search.objective=worst_ratio", "search.band=[0.4, 0.1]")
    assert "band 0.4 to 0.1 is too narrow" in line


def test_measured_prior_needs_a_picture(tmp_path):
    line = fault(tmp_path, "prior={measured: true}", "targets=[{name: a, kind: usaf1951}]")
    assert "prior.measured: measured needs a photograph" in line


@pytest.mark.parametrize("name", ["design_pitches", "design_slm"])
def test_examples(name):
    config = load_design(ROOT / "configs" / f"{name}.yaml")
    assert config.prior.measured
    assert len(config.targets) == 4
    assert bool(broken_limits(config)) == (name == "design_slm")


def test_kinds_are_told_apart(tmp_path):
    path = tiny.write(tmp_path)
    with pytest.raises(ConfigError, match="give it to 'thincam design'"):
        load_experiment(path)
    for name, told in (("quick", "is a study, for"), ("fza_refocus", "is of kind 'refocus', for")):
        with pytest.raises(ConfigError, match=told):
            load_design(ROOT / "configs" / f"{name}.yaml")
