"""YAML, files and overrides: every fault is one line that names its place."""

import re

import pytest
from commands.study.test_config import BASE, changed, faults, line_of, load

from thincam_jax.commands.config_file import ConfigError, override, read_raw, read_value
from thincam_jax.commands.kinds import load_experiment


class TestYaml:
    def test_repeated_key(self, tmp_path):
        """PyYAML would take the last one without a word."""
        text = changed("seed: 7", "seed: 7\nwavelength: 600 nm")
        (line,) = faults(tmp_path, text)
        first, second = line_of(text, "wavelength: 600 nm"), line_of(text, "wavelength: 500 nm")
        assert line.startswith(f"{second}: wavelength: this key stands twice")
        assert f"first in line {first}" in line

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

    def test_aliases_that_stand_for_billions(self, tmp_path):
        """Refused before anything is built: some 400 bytes, 8e9 entries."""
        rows = ["a0: &a0 [x]"]
        rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 11)]
        (line,) = faults(tmp_path, "\n".join(rows))
        assert "holds 8335593969 entries (an alias counts as all that it stands for)" in line
        merged = ["a0: &a0 {x: 1}"]
        merged += [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}" for n in range(1, 11)]
        (line,) = faults(tmp_path, "\n".join(merged))
        assert "(an alias counts as all that it stands for), at most 100000 are read" in line
        with pytest.raises(ConfigError, match="--set title: holds .* entries .an alias counts"):
            read_value("{" + ", ".join(rows) + "}", "--set title")

    @pytest.mark.parametrize(
        "number", ["0x" + "f" * 5000, "9" * 5000, "0b" + "1" * 20_000, "1:" * 3000 + "1"]
    )
    def test_numbers_of_thousands_of_digits(self, tmp_path, number):
        for given in (number, "1:" * 3000 + "1.5"):  # which no float holds
            path = tmp_path / "a.yaml"
            path.write_text(f"name: a\nseed: {given}\n")
            with pytest.raises(ConfigError) as caught:
                read_raw(path)
            fault = f"line 2 has a number of {len(given)} characters; give at most 200"
            assert str(caught.value) == f"{path}: {fault}"
            with pytest.raises(ConfigError, match="^--set seed=.*: line 1 has a number of"):
                override({}, f"seed={given}")

    def test_number_with_an_exponent_is_a_number(self, tmp_path):
        """PyYAML reads 1e4 as a text."""
        config = load(tmp_path, changed("full_well: 13500", "full_well: 1e4"))
        assert config.sensor.full_well == 1e4

    @pytest.mark.parametrize(("broken", "line"), [("pitch: [40", "(9|10)"), ("a: b: c", "9")])
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
            load_experiment(path)

    def test_folder(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="is a folder; give the path of a YAML"):
            load_experiment(tmp_path)

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="nothing.yaml is missing; give the path"):
            load_experiment(tmp_path / "nothing.yaml")


class TestOverrides:
    def test_values_lists_and_new_keys(self, tmp_path):
        config = load(
            tmp_path,
            BASE,
            "wavelength=600nm",
            "sensor.shape.1=80",
            "methods.1.shots.0.beta=30 rad/mm^2",
            "noise.signal_power=without_mean",
            "mask.pixel_pitch=40 um",
            "targets=[{name: only, kind: usaf1951}]",
        )
        assert config.wavelength == pytest.approx(6e-4)
        assert config.sensor.shape == (48, 80)
        assert config.methods[1].shots[0].beta == 30.0
        assert config.methods[0].shots[0].beta == 25.0
        assert config.noise.signal_power == "without_mean"
        assert config.mask.pixel_pitch == pytest.approx(0.04)
        assert [t.name for t in config.targets] == ["only"]

    @pytest.mark.parametrize(
        ("override", "field", "part"),
        [
            ("sensor.pitch=5", "sensor.pitch", "5 has no unit"),
            ("mask.widht=2 mm", "mask.widht", "did you mean 'width'?"),
            ("seed=", "seed", "null: input should be a valid integer"),
            ("noise.snr_db=none", "noise.snr_db", "for none write null"),
            ("noise=", "methods[1].kind", "give a 'noise' section"),
        ],
    )
    def test_fault_names_the_override(self, override, field, part, tmp_path):
        lines = faults(tmp_path, BASE, override)
        line = lines[0]
        place = "--set " + override
        if override == "noise=":  # what lacks the noise is in the file
            place = str(line_of(BASE, "kind: wiener"))
        assert line.startswith(f"{place}: {field}: ")
        assert part in line

    @pytest.mark.parametrize("override", ["seed", "=5", "a..b=5", ".seed=5", ""])
    def test_malformed(self, override, tmp_path):
        (line,) = faults(tmp_path, BASE, override)
        assert line == f"--set {override}: write it as a.b=value, such as mask.width=5.632mm"

    @pytest.mark.parametrize(
        ("override", "part"),
        [
            ("targets.2.name=x", "targets has no entry 2"),
            ("targets.first.name=x", "targets has no entry 'first'"),
            ("sensor.shape.2=5", "sensor.shape has no entry 2"),
            ("title=[a", "'[a' is not valid YAML; put texts in quotes"),
        ],
    )
    def test_no_such_place_or_value(self, override, part, tmp_path):
        (line,) = faults(tmp_path, BASE, override)
        assert line == f"--set {override}: {part}"
