"""Every shipped experiment file: what it resolves to, its JSON Schema, and `thincam explain`."""

import json
import re

import numpy as np
import pytest
import yaml
from commands.test_cli import call, called, one_line
from jsonschema import Draft202012Validator

from helpers import ROOT
from thincam_jax.commands.kinds import KINDS, load_experiment, read_kind
from thincam_jax.measured.calibration.alignment import Alignment

FILES = sorted((ROOT / "configs").glob("*.yaml"))
SCHEMAS = ROOT / "configs/schemas"
# Of each file, without its texts for readers; a changed default or reading of a unit shows.
RESOLVED = json.loads((ROOT / "tests/commands/resolved.json").read_text("utf-8"))


def resolved(path):
    config = load_experiment(path, command=None)
    data = config.model_dump(mode="json", exclude_none=True, by_alias=True)
    text = json.dumps(data).replace(str((ROOT / "configs").resolve()), "configs")
    return {key: value for key, value in json.loads(text).items() if key not in ("title", "notes")}


@pytest.mark.parametrize("stem", sorted({*RESOLVED, *(path.stem for path in FILES)}))
def test_resolved_values(stem, tmp_path):
    """What a run keeps of its experiment, with every default written out, means the same."""
    assert resolved(ROOT / f"configs/{stem}.yaml") == RESOLVED[stem]
    written = json.dumps(RESOLVED[stem]).replace('"configs/', f'"{ROOT}/configs/')
    (tmp_path / "kept.yaml").write_text(written, "utf-8")
    assert resolved(tmp_path / "kept.yaml") == RESOLVED[stem]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_schema_takes_it_and_no_number_without_its_unit(path):
    raw = yaml.safe_load(path.read_text("utf-8"))
    schema = json.loads((SCHEMAS / f"{raw.get('kind', 'study')}.json").read_text("utf-8"))
    validator = Draft202012Validator(schema)
    assert [error.message for error in validator.iter_errors(raw)] == []
    for entries, key in with_units(raw):
        given, entries[key] = entries[key], 5.5
        assert not validator.is_valid(raw), f"{key} without its unit"
        entries[key] = given
    assert not validator.is_valid(raw | {"colour": 1})


@pytest.mark.parametrize("kind", KINDS)
def test_schemas_of_the_shipped_files_are_those_of_the_command(kind):
    """Refreshed by `thincam schema KIND > configs/schemas/KIND.json`."""
    result = called("schema", kind)
    assert (SCHEMAS / f"{kind}.json").read_text("utf-8") == result.stdout
    Draft202012Validator.check_schema(json.loads(result.stdout))


DESIGNS = [path.stem for path in FILES if path.stem.startswith("design")]
STUDIES = ("flatcam", "fza_admm_tv", "fza_harmonics", "fza_slm_chart", "moving", "mura")
RIGS = ("rig_pairs", "rig_phase")


def but(*slow):
    """Every file; some are thorough, as others are of their kind."""
    marks = {name: [pytest.mark.thorough] for name in slow}
    files = [pytest.param(path, marks=marks.get(path.stem, [])) for path in FILES]
    return pytest.mark.parametrize("path", files, ids=lambda path: path.stem)


def options_of(path, folder):
    """Options in place of what is not shipped: photographs, and what another run has found."""
    if path.stem == "denoiser":
        return ["--set", "sources=[{name: drawn, kind: drawn, count: 2}]"]
    if path.stem == "trained":
        psf = np.pad(np.random.default_rng(0).random((500, 600)), ((150,), (180,)))
        np.save(folder / "psf.npy", psf)
        sources = "sources=[{name: drawn, kind: drawn, count: 2}]"
        return ["--set", sources, "--set", f"psf.path={folder / 'psf.npy'}"]
    if path.stem == "rig_pairs":
        found = np.array([1.0, 0.0, 0.0, 0.0]), np.eye(4)
        Alignment((240, 320), 0.5, *found, 12, 12, 0.01).save(folder / "alignment.json")
        return ["--set", f"alignment={folder / 'alignment.json'}"]
    return []


FZA = ("fza_field", "fza_refocus", "fza_superresolution")
STS = ("stis", "sts_calibration", "sts_colours")


@but(*DESIGNS, *STUDIES, *RIGS, *FZA, *STS, "mosaic")
def test_dry_run(path, tmp_path):
    out, options = tmp_path / "out", options_of(path, tmp_path)
    result = called(read_kind(path).command, path, "--out", out, "--dry-run", *options)
    *computed, written, end = result.stdout.splitlines()
    assert len(computed) >= 1 and all(re.search("[0-9]", line) for line in computed)
    assert written.startswith(f"writes to {out}: ")
    assert end == "dry run: nothing was done"
    assert not out.exists()


def test_dry_run_refuses_what_a_run_would(tmp_path):
    study = ROOT / "configs/quick.yaml"
    (tmp_path / "mine.txt").write_text("mine")
    line = one_line(call("run", study, "--out", tmp_path, "--dry-run"))
    assert line.startswith(f"--out {tmp_path}: is not empty and holds no run")
    fault = one_line(call("run", study, "--set", "targets.0.pixels=1", "--dry-run"))
    assert fault.startswith("--set targets.0.pixels=1: targets[0].pixels: ")


def with_units(data):
    """Section and key, or list and index, of every number with a unit."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        if isinstance(value, (dict, list)):
            yield from with_units(value)
        elif re.fullmatch(r"-?[\d.]+ ?(nm|um|mm|m|ms|s|deg|rad|(rad)?/mm\^2)", str(value)):
            yield data, key


class TestExplain:
    def test_places(self):
        path = ROOT / "configs/quick.yaml"
        result = called("explain", path, "--set", "noise.snr_db=40")
        rows = dict(re.split(r" +# ", line) for line in result.stdout.splitlines() if "#" in line)
        given = path.read_text("utf-8").splitlines()
        line = next(n for n, text in enumerate(given, 1) if text.startswith("  pitch: 11 um"))
        assert rows["sensor.pitch: 0.011 mm"] == f"{path}:{line}"
        assert rows["sensor.full_well: 13500.0"] == "default"
        assert rows["noise.snr_db: 40.0"] == "--set noise.snr_db=40"

    @but(*DESIGNS[1:], *STUDIES, *RIGS, "mosaic", "fza_superresolution")
    def test_every_file(self, path, tmp_path):
        result = called("explain", path, *options_of(path, tmp_path))
        *values, work = result.stdout.splitlines()
        assert f"name: {load_experiment(path, command=None).name}" in values[0]
        assert re.search("operations$|frames|batches$|entries|seeds$|evaluations$", work)

    def test_costs_of_its_cameras(self):
        lines = call("explain", ROOT / "configs/quick.yaml").stdout.splitlines()
        assert any(re.match("pixel_integration: (true|false) ", line) for line in lines)
        costs = [line for line in lines if line.startswith("PSF at ")]
        assert len(costs) == 3  # two distances, and another β at one of them
        told = [re.search(r": separable, predicted error (\S+), .* MiB", line) for line in costs]
        assert all(one and float(one[1]) < 0.01 for one in told)
