"""Experiment files: every fault is one line that names the place, the field and what is allowed."""

import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import ROOT
from thincam_jax.config import ConfigError, StudyConfig, dump_config, load_config, slug
from thincam_jax.targets import sample_images

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

ONE_SHOT = """synthesis: contrasts
    shots:
      - {beta: 25 rad/mm^2, distance: 3 mm}
"""


def load(folder, text, *overrides):
    path = folder / "study.yaml"
    path.write_text(text, encoding="utf-8")
    return load_config(path, overrides)


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


def test_base_is_read_in_the_units_of_the_package(tmp_path):
    config = load(tmp_path, BASE)
    assert config.wavelength == 5e-4
    assert config.sensor.pitch == 0.04
    assert config.sensor.shape == (48, 64)
    assert config.methods[0].shots[0].beta == 25.0
    assert config.methods[1].phases == (0.0, pytest.approx(1.5 * math.pi))
    assert config.methods[0].published.resolved == 4.6
    assert (config.seed, config.model, config.noise.snr_db) == (7, "separable", 30.0)


# what is in the file, what it is changed to, the field, what the message must hold
FAULTS = {
    "no unit": ("pitch: 40 um", "pitch: 40", "sensor.pitch", ["40 has no unit", '"180 mm"']),
    "no unit, exponent": ("width: 2 mm", "width: 1e-3", "mask.width", ["1e-3 has no unit"]),
    "wrong unit": ("pitch: 40 um", "pitch: 40 s", "sensor.pitch", ["a time, not a length"]),
    "unknown unit": ("pitch: 40 um", "pitch: 40 foo", "sensor.pitch", ['unknown unit "foo"', "nm"]),
    "angle for a length": ("500 nm", "500 deg", "wavelength", ["an angle, not a length"]),
    "negative": ("width: 2 mm", "width: -2 mm", "mask.width", ["-2 is not positive", "above zero"]),
    "zero": ("width: 80 mm", "width: 0 mm", "object.width", ["0 is not positive", "above zero"]),
    "NaN": ("width: 80 mm", "width: nan mm", "object.width", ["not finite"]),
    "YAML NaN": ("width: 80 mm", "width: .nan", "object.width", ["no unit"]),
    "infinity": ("snr_db: 30", "snr_db: .inf", "noise.snr_db", ["inf: ", "finite number"]),
    "negative curvature": (
        *("- beta: 25 rad/mm^2", "- beta: -25 rad/mm^2"),
        *("methods[0].shots[0].beta", ["-25 is not positive"]),
    ),
    "unknown key": ("  profile: cosine", "  widht: 2 mm", "mask.widht", ["unknown key"]),
    "unknown top key": ("seed: 7", "sede: 7", "sede", ["unknown key", "seed, wavelength, model"]),
    "unknown key in a list": (
        *("        distance: 3 mm", "        distance: 3 mm\n        colour: red"),
        *("methods[0].shots[0].colour", ["unknown key; allowed here: beta, distance, wavelength"]),
    ),
    "unknown model": (
        *("model: separable", "model: sperable", "model"),
        ["'sperable' is unknown", "'geometric'", "'separable'", "'rayleigh_sommerfeld'"],
    ),
    "unknown kind": (
        *("kind: wiener", "kind: winer", "methods[1].kind"),
        ["'winer' is unknown", "'fringe_scanning', 'wiener' or 'admm_tv'"],
    ),
    "unknown synthesis": (
        *("synthesis: separate", "synthesis: pairs", "methods[1].synthesis"),
        ["'pairs'", "'fringe_scanning', 'phase_pairs', 'contrasts' or 'separate'"],
    ),
    "unknown photograph": (
        *("image: coffee", "image: coffe", "targets[1]"),
        ["image 'coffe' is unknown; choose one of", *sample_images()],
    ),
    "text for a number": ("seed: 7", "seed: seven", "seed", ["'seven'", "valid integer"]),
    "negative seed": ("seed: 7", "seed: -1", "seed", ["-1", "greater than or equal to 0"]),
    "number for a text": (
        "title: A study",
        "title: 5",
        "title",
        ["5: input should be a valid str"],
    ),
    "text for a section": ("noise:\n  snr_db: 30", "noise: 30", "noise", ["30 is not a section"]),
    "part of a pixel": ("[48, 64]", "[48, 64.5]", "sensor.shape[1]", ["64.5", "integer"]),
    "no pixel": ("[48, 64]", "[48, 0]", "sensor.shape[1]", ["0: ", "greater than or equal to 1"]),
    "list too short": ("[48, 64]", "[48]", "sensor.shape[1]", ["the list needs this entry"]),
    "list too long": ("[48, 64]", "[48, 64, 3]", "sensor.shape", ["3 entries", "at most 2"]),
    "no list": ("[48, 64]", "48", "sensor.shape", ["48 is not a list; write it as [a, b]"]),
    "no phase": (
        *("phases: [0 rad, 270 deg]", "phases: []", "methods[1].phases"),
        ["[] has 0 entries; give at least 1"],
    ),
    "no target": (
        BASE[BASE.index("targets:") :],
        "targets: []",
        *("targets", ["[] has 0 entries; give at least 1"]),
    ),
    "section without a value": (
        *("noise:\n  snr_db: 30", "noise:"),
        *("methods[1].kind", ["give a 'noise' section"]),
    ),
    "phases given to fringe scanning": (
        *("synthesis: separate", "synthesis: fringe_scanning", "methods[1]"),
        ["synthesis fringe_scanning sets the phases itself; drop 'phases'"],
    ),
    "contrasts of one capture": (
        *(BASE[BASE.index("synthesis: separate") : BASE.index("targets:")], ONE_SHOT, "methods[1]"),
        ["contrasts compares captures; give two phases or shots"],
    ),
    "contrasts of two distances": (
        BASE[BASE.index("synthesis: separate") : BASE.index("targets:")],
        ONE_SHOT + "      - {beta: 25 rad/mm^2, distance: 4 mm}\n",
        *("methods[1]", ["needs shots at one distance", "use phase_pairs or fringe_scanning"]),
    ),
    "synthesis given to fringe scanning": (
        *("kind: fringe_scanning", "kind: fringe_scanning\n    synthesis: separate"),
        *("methods[0]", ["takes one shot and its own synthesis"]),
    ),
    "the same phase twice": (
        "[0 rad, 270 deg]",
        "[0 rad, 0 deg]",
        *("methods[1].phases", ["phases hold an entry twice"]),
    ),
    "path for a photograph": (
        *("image: coffee", "path: coffee.png"),
        *("targets[1]", ["kind photograph needs 'image'"]),
    ),
    "file without a path": (
        *("kind: photograph\n    image: coffee", "kind: file", "targets[1]"),
        ["kind file needs 'path'"],
    ),
    "image for the chart": (
        *("kind: usaf1951", "kind: usaf1951\n    image: coffee", "targets[0]"),
        ["kind usaf1951 takes no 'image'"],
    ),
    "same names": (
        *("name: wiener", "name:  scan", "methods[1].name"),
        ["'scan' and 'scan' of methods[0]", "choose another name"],
    ),
    "names of one file": (
        *("name: picture", "name: Chart.", "targets[1].name"),
        ["'Chart.' and 'chart' of targets[0] give the same file name 'chart'"],
    ),
    "slash in a name": ("name: picture", "name: a/b", "targets[1].name", ["'a/b'", "pattern"]),
    "empty name": ("name: picture", "name: ''", "targets[1].name", ["''", "at least 1 char"]),
    "two kinds of noise": (
        *("snr_db: 30", "snr_db: 30\n  read_noise: 2", "noise"),
        ["give either snr_db", "or read_noise"],
    ),
    "negative read noise": (
        *("snr_db: 30", "read_noise: -1", "noise.read_noise"),
        ["-1: ", "greater than or equal to 0"],
    ),
    "shot noise alone without exposure": (
        *("snr_db: 30", "read_noise: 0", "noise.read_noise"),
        ["give sensor.exposure"],
    ),
    "electrons without exposure": (
        *("snr_db: 30", "read_noise: 2", "noise.read_noise"),
        ["give sensor.exposure, such as 0.9"],
    ),
    "wiener without noise": (
        *("noise:\n  snr_db: 30\n", "", "methods[1].kind"),
        ["wiener weighs noise against signal; give a 'noise' section"],
    ),
}

# The line is that of the changed text where nothing else is said.
LINES = {
    "unknown photograph": "- name: picture",
    "phases given to fringe scanning": "- name: wiener",
    "contrasts of one capture": "- name: wiener",
    "contrasts of two distances": "- name: wiener",
    "synthesis given to fringe scanning": "- name: scan",
    "the same phase twice": "phases: [0 rad",
    "path for a photograph": "- name: picture",
    "file without a path": "- name: picture",
    "image for the chart": "- name: chart",
    "unknown key in a list": "colour: red",
    "two kinds of noise": "noise:",
    "section without a value": "kind: wiener",
    "wiener without noise": "kind: wiener",
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault(name, tmp_path):
    old, new, field, parts = FAULTS[name]
    text = changed(old, new)
    (line,) = faults(tmp_path, text)
    place = LINES.get(name, new)
    assert line.startswith(f"{line_of(text, place)}: {field}: ")
    for part in parts:
        assert part in line


def test_unknown_key_lists_the_keys_of_its_section_only(tmp_path):
    (line,) = faults(tmp_path, changed("  profile: cosine", "  shape: cosine"))
    allowed = line.split("allowed here: ")[1].split(", ")
    assert allowed == ["width", "profile", "harmonics", "pixel_pitch", "fill_factor"]


@pytest.mark.parametrize(
    ("removed", "field", "place"),
    [
        ("  pitch: 40 um\n", "sensor.pitch", "sensor:"),
        ("  width: 2 mm\n", "mask.width", "mask:"),
        ("    kind: wiener\n", "methods[1].kind", "- name: wiener"),
        ("        distance: 3 mm\n", "methods[0].shots[0].distance", "- beta: 25"),
    ],
)
def test_missing_key_is_reported_where_its_section_begins(removed, field, place, tmp_path):
    text = changed(removed, "")
    (line,) = faults(tmp_path, text)
    assert line == f"{line_of(text, place)}: {field}: missing; this key is needed"


def test_missing_section(tmp_path):
    (line,) = faults(tmp_path, changed("object:\n  distance: 100 mm\n  width: 80 mm\n", ""))
    assert line == "1: object: missing; this key is needed"


def test_a_faulty_entry_is_not_a_missing_one_too(tmp_path):
    """Pydantic also calls a list too short when its only entry has a fault."""
    text = BASE[: BASE.index("  - name: wiener")] + BASE[BASE.index("targets:") :]
    text = changed("beta: 25 rad/mm^2", "beta: 25 mm", text)
    (line,) = faults(tmp_path, text)
    assert line.startswith(f"{line_of(text, 'beta: 25 mm')}: methods[0].shots[0].beta: ")


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


class TestYaml:
    def test_repeated_key(self, tmp_path):
        """PyYAML would take the last one without a word."""
        text = changed("seed: 7", "seed: 7\nwavelength: 600 nm")
        (line,) = faults(tmp_path, text)
        first, second = line_of(text, "wavelength: 600 nm"), line_of(text, "wavelength: 500 nm")
        assert line.startswith(f"{second}: wavelength: this key stands twice")
        assert f"first in line {first}" in line

    def test_repeated_keys_deep_inside_and_several(self, tmp_path):
        text = changed("{beta: 21 rad/mm^2,", "{beta: 20 /mm^2, beta: 21 /mm^2,")
        text = changed("  pitch: 40 um", "  pitch: 40 um\n  pitch: 41 um", text)
        lines = faults(tmp_path, text)
        assert [line.split(": ")[:2] for line in lines] == [
            [str(line_of(text, "pitch: 41 um")), "pitch"],
            [str(line_of(text, "{beta: 20")), "beta"],
        ]

    def test_equal_keys_in_different_sections_are_no_repetition(self, tmp_path):
        load(tmp_path, BASE)  # width stands in mask and in object

    def test_anchors(self, tmp_path):
        text = changed("      - beta: 25 rad/mm^2\n", "      - &near\n        beta: 25 rad/mm^2\n")
        text = changed("{beta: 25 rad/mm^2, distance: 3 mm}", "*near", text)
        text = changed("{beta: 21 rad/mm^2,", "{<<: *near, beta: 21 rad/mm^2,", text)
        assert load(tmp_path, text) == load(tmp_path, BASE)

    def test_fault_behind_an_alias_has_the_line_of_the_anchor(self, tmp_path):
        text = changed("      - beta: 25 rad/mm^2\n", "      - &near\n        beta: 25 mm\n")
        text = changed("{beta: 25 rad/mm^2, distance: 3 mm}", "*near", text)
        lines = faults(tmp_path, text)
        assert [line.split(": ")[:2] for line in lines] == [
            [str(line_of(text, "beta: 25 mm")), f"methods[{n}].shots[0].beta"] for n in (0, 1)
        ]

    def test_anchor_inside_itself(self, tmp_path):
        text = changed("title: A study", "title: &loop [*loop]")
        (line,) = faults(tmp_path, text)
        assert "alias inside its anchor" in line

    def test_unit_without_a_space(self, tmp_path):
        config = load(tmp_path, changed("pitch: 40 um", "pitch: 40um"))
        assert config.sensor.pitch == 0.04

    def test_number_with_an_exponent_is_a_number(self, tmp_path):
        """PyYAML reads 1e4 as a text."""
        config = load(tmp_path, changed("full_well: 13500", "full_well: 1e4"))
        assert config.sensor.full_well == 1e4

    @pytest.mark.parametrize(
        ("broken", "line"),
        [
            ("pitch: [40", "(9|10)"),
            ("\tpitch: 40 um", "9"),
            ("pitch: 'a", r"\d+"),
            ("a: b: c", "9"),
        ],
    )
    def test_invalid(self, broken, line, tmp_path):
        (found,) = faults(tmp_path, changed("  pitch: 40 um", f"  {broken}"))
        assert re.match(rf"{line}: not valid YAML: \w+", found)

    def test_date_that_does_not_exist(self, tmp_path):
        (line,) = faults(tmp_path, changed("title: A study", "title: 2020-13-45"))
        assert "not valid YAML: month must be in 1..12" in line
        assert "quotes" in line

    @pytest.mark.parametrize(
        "text", ["", "# only a comment\n", "- a\n- b\n", "just a text", "---\n"]
    )
    def test_no_mapping(self, text, tmp_path):
        (line,) = faults(tmp_path, text)
        assert line.startswith("1: give a mapping of 'key: value' lines")

    def test_key_that_is_no_text(self, tmp_path):
        text = changed("seed: 7", "7: seed")
        (line,) = faults(tmp_path, text)
        assert line == f"{line_of(text, '7: seed')}: 7: a key must be a text; put it in quotes"

    def test_program_in_a_tag_is_not_run(self, tmp_path):
        text = changed("title: A study", "title: !!python/object/apply:os.getcwd []")
        (line,) = faults(tmp_path, text)
        assert re.match(r"3: not valid YAML: could not determine a constructor", line)


class TestFile:
    def test_not_utf8(self, tmp_path):
        path = tmp_path / "study.yaml"
        path.write_bytes(BASE.replace("A study", "Größe").encode("latin-1"))
        with pytest.raises(ConfigError, match=r"study.yaml: not a text file in UTF-8"):
            load_config(path)

    def test_binary(self, tmp_path):
        path = tmp_path / "study.yaml"
        path.write_bytes(b"name: a\x00b\n")
        with pytest.raises(ConfigError, match="study.yaml.*not valid YAML"):
            load_config(path)

    def test_folder(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="is a folder; give the path of a YAML"):
            load_config(tmp_path)

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="nothing.yaml is missing; give the path"):
            load_config(tmp_path / "nothing.yaml")


class TestOverrides:
    def test_values_lists_and_new_keys(self, tmp_path):
        config = load(
            tmp_path,
            BASE,
            "wavelength=600nm",
            "sensor.shape.1=80",
            "methods.1.shots.0.beta=30 rad/mm^2",
            "noise.signal_power=without_mean",
            "mask.fill_factor=0.5",
            "targets=[{name: only, kind: usaf1951}]",
        )
        assert config.wavelength == pytest.approx(6e-4)
        assert config.sensor.shape == (48, 80)
        assert config.methods[1].shots[0].beta == 30.0
        assert config.methods[0].shots[0].beta == 25.0
        assert config.noise.signal_power == "without_mean"
        assert config.mask.fill_factor == 0.5
        assert [t.name for t in config.targets] == ["only"]

    def test_the_last_one_counts(self, tmp_path):
        assert load(tmp_path, BASE, "seed=1", "seed=2").seed == 2

    def test_section_that_the_file_lacks(self, tmp_path):
        text = changed("noise:\n  snr_db: 30\n", "")
        assert load(tmp_path, text, "noise.snr_db=20").noise.snr_db == 20

    @pytest.mark.parametrize(
        ("override", "field", "part"),
        [
            ("sensor.pitch=5", "sensor.pitch", "5 has no unit"),
            ("mask.widht=2 mm", "mask.widht", "unknown key; allowed here: width, profile"),
            ("lens.width=2 mm", "lens", "unknown key; allowed here: name, title"),
            ("methods.1.shots.1.beta=-1 /mm^2", "methods[1].shots[1].beta", "not positive"),
            ("sensor.shape=[48]", "sensor.shape[1]", "the list needs this entry"),
            ("noise={snr: 30}", "noise.snr", "unknown key; allowed here: snr_db"),
            ("noise={snr_db: loud}", "noise.snr_db", "'loud': input should be a valid number"),
            ("seed=", "seed", "None: input should be a valid integer"),
            ("noise=", "methods[1].kind", "give a 'noise' section"),
            ("targets.1.name=chart", "targets[1].name", "same file name 'chart'"),
        ],
    )
    def test_fault_names_the_override(self, override, field, part, tmp_path):
        lines = faults(tmp_path, BASE, override)
        line = lines[-1] if override == "noise={snr: 30}" else lines[0]
        place = "--set " + override
        if override == "noise=":  # what lacks the noise is in the file
            place = str(line_of(BASE, "kind: wiener"))
        assert line.startswith(f"{place}: {field}: ")
        assert part in line

    def test_other_faults_keep_their_place(self, tmp_path):
        text = changed("pitch: 40 um", "pitch: 40")
        lines = faults(tmp_path, text, "sensor.shape.0=0")
        assert [line.split(": ")[:2] for line in lines] == [
            ["--set sensor.shape.0=0", "sensor.shape[0]"],
            [str(line_of(text, "pitch: 40")), "sensor.pitch"],
        ]

    def test_an_override_repairs_the_file(self, tmp_path):
        text = changed("pitch: 40 um", "pitch: 40")
        assert load(tmp_path, text, "sensor.pitch=40 um").sensor.pitch == 0.04

    @pytest.mark.parametrize("override", ["seed", "=5", "a..b=5", ".seed=5", ""])
    def test_malformed(self, override, tmp_path):
        (line,) = faults(tmp_path, BASE, override)
        assert line == f"--set {override}: write it as a.b=value, such as mask.width=5.632mm"

    @pytest.mark.parametrize(
        ("override", "part"),
        [
            ("targets.2.name=x", "targets has no entry 2"),
            ("targets.first.name=x", "targets has no entry 'first'"),
            ("targets.-1.name=x", "targets has no entry '-1'"),
            ("targets.².name=x", "targets has no entry '²'"),
            ("seed.a=5", "seed has no entry 'a'"),
            ("sensor.shape.2=5", "sensor.shape has no entry 2"),
            ("title=[a", "'[a' is not valid YAML; put texts in quotes"),
            ("title=2020-13-45", "'2020-13-45' is not valid YAML; put texts in quotes"),
        ],
    )
    def test_no_such_place_or_value(self, override, part, tmp_path):
        (line,) = faults(tmp_path, BASE, override)
        assert line == f"--set {override}: {part}"


SHIPPED = sorted(p.name for p in (ROOT / "configs").glob("fza_*.yaml"))
SHIPPED.remove("fza_refocus.yaml")  # of another kind: tests/depth/test_run_refocus.py


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_files_round_trip(name, tmp_path):
    config = load_config(ROOT / "configs" / name)
    assert load(tmp_path, dump_config(config)) == config


LENGTHS = st.floats(1e-7, 1e7)
WAVELENGTHS = st.floats(1e-5, 1.0)


@settings(max_examples=40, deadline=None)
@given(
    WAVELENGTHS, LENGTHS, LENGTHS, st.floats(-100, 100), st.text("aÄ#:'\"\\{[ \n%-", max_size=150)
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


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("conventional, d = 5.0 mm", "conventional-d-5.0-mm"),
        ("USAF-1951", "usaf-1951"),
        ("..", "unnamed"),
        (" .a. ", "a"),
    ],
)
def test_slug(name, file):
    assert slug(name) == file


@pytest.mark.parametrize("extra", ["", ", wavelength: 0.5 um"])
def test_same_shot_twice(tmp_path, extra):
    """One capture under two descriptions would count its noise as two independent ones."""
    text = changed(
        "{beta: 21 rad/mm^2, distance: 3 mm}", "{beta: 25 /mm^2, distance: 0.3 cm" + extra + "}"
    )
    (line,) = faults(tmp_path, text)
    number = line_of(text, "    synthesis: separate") + 1  # the line of the second 'shots:'
    assert line.startswith(f"{number}: methods[1].shots: shots hold an entry twice")


@pytest.mark.parametrize("override", ["wavelength=500 m", "wavelength=1e-30 nm"])
def test_wavelengths_are_those_of_light(tmp_path, override):
    path = tmp_path / "study.yaml"
    path.write_text(BASE, encoding="utf-8")
    with pytest.raises(ConfigError, match="is no wavelength of light; give 10 nm to 1 mm"):
        load_config(path, (override,))
