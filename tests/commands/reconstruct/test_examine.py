"""Findings in the terminal, the record, `--json` and `--strict`; `thincam examine`."""

import json

import numpy as np
import pytest
import tifffile
from commands.reconstruct import simulated
from commands.test_cli import call, called


@pytest.fixture
def paths(tmp_path):
    return simulated.grey_files(tmp_path)


def reconstruct(paths, out, *more, psf="psf", capture="capture"):
    files = "--psf", paths[psf], "--capture", paths[capture], "--background", paths["dark"]
    return call("reconstruct", *files, "--out", out, "--iterations", 12, *more)


def warnings_of(result):
    head = "thincam: warning: "
    return [line.removeprefix(head) for line in result.stderr.splitlines() if head in line]


def test_clean_files(paths, tmp_path):
    result = call("examine", paths["capture"], "--psf", paths["psf"], "--bits", 12, "--strict")
    assert (result.exit_code, result.output) == (0, "nothing found\n")
    result = reconstruct(paths, tmp_path / "a.npy", "--bits", 12, "--strict")
    assert result.exit_code == 0 and result.stderr == ""
    assert json.loads((tmp_path / "a.json").read_text("utf-8"))["examination"] == []


def test_swapped_files(paths, tmp_path):
    out = tmp_path / "a.npy"
    swapped = {"psf": "capture", "capture": "psf"}
    result = reconstruct(paths, out, "--bits", 12, **swapped)
    assert result.exit_code == 0
    told = warnings_of(result)
    assert told[0].startswith(f"capture {paths['psf']}: ")
    assert told[0].endswith("exchange --psf and --capture")
    assert len(told) == 1 and "explains almost nothing of the capture" in result.stderr
    found = json.loads(out.with_suffix(".json").read_text("utf-8"))["examination"]
    assert [one["name"] for one in found] == ["swapped", "unexplained"]
    assert all(one["severe"] for one in found)
    result = reconstruct(paths, out, "--bits", 12, "--json", **swapped)
    printed = [json.loads(line) for line in result.stdout.splitlines()]
    assert printed[1] == {"findings": found}
    out.unlink()
    result = reconstruct(paths, out, "--bits", 12, "--strict", **swapped)
    assert result.exit_code == 2 and not out.exists()
    assert result.stderr.splitlines()[-1].endswith("--capture (an error by --strict)")
    words = paths["psf"], "--psf", paths["capture"], "--bits", 12
    result = call("examine", *words)
    assert (result.exit_code, result.stdout) == (0, f"severe: {told[0]}\n")
    assert call("examine", *words, "--strict").exit_code == 2
    (line,) = call("examine", *words, "--json").stdout.splitlines()
    assert json.loads(line)["findings"] == found[:1]


def test_bits_that_nobody_told(paths, tmp_path):
    """Saturated pixels are left out as with --bits; a hot pixel of the PSF is reported once."""
    raw = simulated.tifffile.imread(paths["capture"])
    raw = np.minimum(raw, 2000)
    captures = tmp_path / "captures"
    captures.mkdir()
    for name in ("first", "second"):
        tifffile.imwrite(captures / f"{name}.tif", raw)
    psf = tifffile.imread(paths["psf"])
    psf[3, 70] = 4000
    tifffile.imwrite(paths["psf"], psf)
    files = "--psf", paths["psf"], "--capture", captures, "--background", paths["dark"]
    result = called("reconstruct", *files, "--out", tmp_path / "out", "--iterations", 5)
    told = warnings_of(result)
    assert sum("hot or dead pixels are filled" in line for line in told) == 1
    plateaus = [line for line in told if "the largest value, 2000, and are not used" in line]
    assert len(plateaus) == 2
    record = json.loads((tmp_path / "out" / "first.json").read_text("utf-8"))
    share = np.mean(raw == 2000)
    assert record["preparation"]["valid_share"] == pytest.approx(1 - share)
    result = call("examine", *sorted(captures.iterdir()))
    assert result.stdout.count("the largest value") == 2


def test_noise_that_was_given(paths, tmp_path):
    """A hundred counts of noise where there are two; the advice takes the warning away."""
    out = tmp_path / "a.npy"
    more = "--bits", 12
    (line,) = warnings_of(reconstruct(paths, out, "--noise", 100, *more))
    assert "counts of noise are found, and 100 are given; leave --noise out" in line
    assert not warnings_of(reconstruct(paths, out, *more))
