"""Several exposures of a PSF or capture, and backgrounds that pair with captures."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from commands.reconstruct import simulated
from commands.reconstruct.test_command import one_line, record_of, runner
from measured.test_examination import quality

from thincam_jax.commands import cli
from thincam_jax.commands.reconstruct.jobs import Inputs, plan_jobs
from thincam_jax.commands.reconstruct.options import Output, Sources
from thincam_jax.measured import Raw

TIMES = ("1ms", "4ms", "16ms")
MORE = ("--bits", 12, "--iterations", 60)


def call(out, *more):
    typed = ("reconstruct", "--out", out, *MORE, *more)
    return runner.invoke(cli.app, [str(part) for part in typed])


def each(option, values):
    return [part for value in values for part in (option, value)]


@pytest.fixture
def files(tmp_path):
    """A PSF and a capture at three exposures, a good one of each, a dark frame; no times."""
    light = simulated.psf()
    view = simulated.capture(simulated.scene()[1:2], light)[0]
    write = simulated.write_tiff
    named = {
        "psf": write(tmp_path / "psf.tif", simulated.counts(light, 3)),
        "capture": write(tmp_path / "capture.tif", simulated.counts(view, 4)),
    }
    for n in range(3):
        for name, image in (("psf", light), ("capture", view)):
            counts = simulated.counts(image, 10 + n, 900 * 4**n)
            named[f"{name}{n}"] = write(tmp_path / f"{name}-{n}.tif", counts)
    return named


def tagged(path, seconds):
    """The file with its exposure, as TIFF has it."""
    time = (33434, 5, 1, (round(1e6 * seconds), 10**6), True)
    tifffile.imwrite(path, tifffile.imread(path), extratags=[time])


def score(path):
    return quality(np.load(path), simulated.scene()[1])


@pytest.mark.thorough
def test_merged_is_as_good_as_unsaturated(files, tmp_path):
    """The issue's 42 and 60 % of the bright pixels: within 1 dB, by --exposure or the files."""
    scores = {}
    psfs, captures = ([files[f"{name}{n}"] for n in range(3)] for name in ("psf", "capture"))
    bright = tifffile.imread(psfs[2]) > simulated.DARK + 900 * 16 * 0.05
    assert np.mean(tifffile.imread(psfs[2])[bright] == 4095) > 0.4
    plain = ("--capture", files["capture"])
    given_psfs = (*each("--psf", psfs), *plain)
    for name, given in {
        "best": ("--psf", files["psf"], *plain),
        "longest": ("--psf", psfs[2], *plain),
        "merged": (*each("--psf", psfs), *each("--exposure", TIMES), *plain),
        "captures": (
            *("--psf", files["psf"], *each("--capture", captures[::-1])),
            *each("--exposure", TIMES[::-1]),
        ),
        "both": (
            *(*each("--psf", psfs), *each("--capture", captures)),
            *each("--exposure", (*TIMES, *TIMES)),
        ),
    }.items():
        out = tmp_path / f"{name}.npy"
        result = call(out, *given)
        assert result.exit_code == 0, result.output
        cut = "psf-2.tif: 2.74 % of the pixels have the largest value, 4095" in result.stderr
        assert cut if name == "longest" else result.stderr == "", result.output
        scores[name] = score(out)
    assert min(scores[n] for n in ("merged", "captures", "both")) > scores["best"] - 1
    assert scores["longest"] < scores["best"] - 3
    record = record_of(tmp_path / "both.npy")
    assert record["exposures"] == [str(path) for path in captures]
    assert record["sources"]["psf"] == [str(path) for path in psfs]
    assert record["preparation"]["psf"]["level"][0] * 4095 == pytest.approx(40, abs=0.5)
    tagged(files["capture"], 0.5)  # one capture, whose own exposure does not matter
    assert call(tmp_path / "again.npy", *each("--exposure", TIMES), *given_psfs).exit_code == 0
    for path, seconds in zip(psfs, (1e-3, 4e-3, 16e-3), strict=True):
        tagged(path, seconds)
    out = tmp_path / "tagged.npy"
    assert call(out, *each("--psf", psfs), *plain).exit_code == 0
    np.testing.assert_array_equal(np.load(out), np.load(tmp_path / "merged.npy"))


def test_times_that_are_missing_or_contradict(files, tmp_path):
    psfs, out = [files[f"psf{n}"] for n in range(3)], tmp_path / "a.npy"
    given = (*each("--psf", psfs), "--capture", files["capture"])
    line = one_line(call(out, *given))
    assert line.startswith(f"{psfs[0]} + ") and "have the exposures [None, None, None] s" in line
    assert "whose files or --exposure, as 4ms, say the time of each; give other scenes" in line
    line = one_line(call(out, *given, "--exposure", "1ms"))
    assert line.startswith("--exposure is given 1 times, for 3 --psf and 1 --capture; give one for")
    assert "--exposure: " in one_line(call(out, *given, "--exposure", "4"))
    line = one_line(call(out, *given, *each("--exposure", ("1ms", "2ms", "16ms"))))
    assert line.endswith("exposed 2 times as long; give linear images of one, and --exposure")
    tagged(psfs[1], 8e-3)
    line = one_line(call(out, *given, *each("--exposure", TIMES)))
    assert "is 0.008 s by the file and 0.004 s by --exposure; leave" in line
    one = ("--psf", files["psf"], "--capture", files["capture"], "--exposure", "1ms")
    assert "is given 1 times, for 1 --psf and 1 --capture" in one_line(call(out, *one))
    two = ("--psf", files["psf"], "--capture", files["capture"], "--capture", tmp_path)
    assert f"{tmp_path}: is a folder" in one_line(call(out, *two))
    far = (*each("--psf", psfs), "--capture", files["capture"], "--distances", "60mm,80mm,100mm")
    assert "give them by one --psf, a folder or a TIFF" in one_line(call(out, *far))
    assert not out.exists()


class TestHotPixels:
    @pytest.fixture
    def hot(self, files, tmp_path):
        """15 hot pixels, of which some saturate, in PSF, capture, dark frame and a map."""
        current, generator = np.zeros(simulated.SHAPE), np.random.default_rng(5)
        places = generator.choice(current.size, 15, replace=False)
        current.flat[places] = np.geomspace(150, 8000, 15)
        for name in ("psf", "capture"):
            raw = tifffile.imread(files[name]) + current
            simulated.write_tiff(files[name], np.minimum(raw, 4095))
        dark = np.minimum(simulated.DARK + current, 4095)
        files["dark"] = simulated.write_tiff(tmp_path / "dark.tif", dark)
        files["dead"] = simulated.write_tiff(tmp_path / "dead.tif", current > 0)
        return files

    @pytest.mark.thorough
    def test_a_dark_frame_or_a_map_mends_them(self, files, tmp_path, hot):
        out, clean = tmp_path / "a.npy", tmp_path / "clean.npy"
        both = ("--psf", hot["psf"], "--capture", hot["capture"])
        scores = {}
        for option in ("dark", "dead"):
            given = ("--background", hot["dark"]) if option == "dark" else ("--dead", hot["dead"])
            result = call(out, *both, *given)
            assert result.exit_code == 0 and result.stderr == "", result.output
            scores[option] = score(out)
        light = simulated.psf()
        simulated.write_tiff(hot["psf"], simulated.counts(light, 3))
        view = simulated.capture(simulated.scene()[1:2], light)[0]
        simulated.write_tiff(hot["capture"], simulated.counts(view, 4))
        assert call(clean, *both, "--background", simulated.DARK).exit_code == 0
        assert min(scores.values()) > score(clean) - 0.5, (scores, score(clean))

    def test_the_difference_to_the_dark_frame_stays(self, hot):
        """Where nothing saturates, and nothing is found any more."""
        rig = Inputs(Sources(hot["psf"], hot["dark"], bits=12))
        (job,) = plan_jobs(hot["capture"], rig.sources, Output(hot["psf"].with_name("a.npy")))
        examined, dark = rig.examine(job)
        assert not examined.findings and isinstance(dark, Raw)
        (capture,), raw = examined.captures, tifffile.imread(hot["capture"]).astype(float)
        full = raw == 4095
        left = capture.pixels - dark.pixels.astype(float)
        expected = raw - tifffile.imread(hot["dark"])
        assert 1 < full.sum() < 10
        np.testing.assert_allclose(left[~full], np.maximum(expected, -40)[~full], atol=1)
        ready = rig.ready(examined, dark)
        assert ready.valid.all()
        assert ready.psf.max() < 3 * np.sort(ready.psf.ravel())[-20]


class TestFolderOfBackgrounds:
    @pytest.fixture
    def folders(self, tmp_path):
        """Captures in ambient light of another strength and gradient each, and that alone."""
        captures, backgrounds = tmp_path / "captures", tmp_path / "backgrounds"
        for folder in (captures, backgrounds):
            folder.mkdir()
        psf = simulated.psf()
        simulated.write_tiff(tmp_path / "psf.tif", simulated.counts(psf, 3))
        for n in range(3):
            view = simulated.capture(simulated.scene(shift=3 * n)[1:2], psf)[0]
            ambient = (600 + 200 * n) * np.linspace(0.2, 1, simulated.SHAPE[1])
            lit = simulated.counts(view, 10 + n, 2000) + ambient
            simulated.write_tiff(captures / f"{n}.tif", lit)
            empty = simulated.counts(np.ones(simulated.SHAPE), 20 + n, 0) + ambient
            simulated.write_tiff(backgrounds / f"{n}.tif", empty)
        return captures, backgrounds

    def names(self, folders, *more):
        planned = plan_jobs(folders[0], Sources(Path("psf"), folders[1]), Output(Path("out")))
        return [path.name for job in planned for path in job.backgrounds]

    def test_pairs_by_name_or_order(self, folders):
        _, backgrounds = folders
        simulated.write_tiff(backgrounds / "psf.tif", np.ones((2, 3)))
        assert self.names(folders) == ["0.tif", "1.tif", "2.tif"]
        (backgrounds / "psf.tif").unlink()
        for n in range(3):
            (backgrounds / f"{n}.tif").rename(backgrounds / f"dark_{9 + n}.tif")
        assert self.names(folders) == ["dark_9.tif", "dark_10.tif", "dark_11.tif"]

    @pytest.mark.parametrize("left", [1, 2])
    def test_no_pair_is_one_line(self, folders, tmp_path, left):
        captures, backgrounds = folders
        (backgrounds / "2.tif").unlink()
        if left == 1:
            for n in range(2):
                (backgrounds / f"{n}.tif").rename(backgrounds / f"dark{n}.tif")
        given = ("--psf", tmp_path / "psf.tif", "--capture", captures)
        line = one_line(call(tmp_path / "out", *given, "--background", backgrounds))
        common = 2 if left == 2 else 0
        assert f"holds 2 backgrounds for 3 captures, {common} named as one; name all" in line
        assert not (tmp_path / "out").exists()

    @pytest.mark.thorough
    def test_each_is_subtracted_of_its_capture(self, folders, tmp_path):
        """Where one level cannot: ambient light has a gradient. The PSF has its own level."""
        captures, backgrounds = folders
        given = ("--psf", tmp_path / "psf.tif", "--capture", captures)
        scores = {}
        for name, more in {"each": ("--background", backgrounds), "found": ()}.items():
            result = call(tmp_path / name, *given, *more)
            assert result.exit_code == 0, result.output
            images = [np.load(tmp_path / name / f"{n}.npy") for n in range(3)]
            truth = [simulated.scene(shift=3 * n)[1] for n in range(3)]
            scores[name] = [quality(a, b) for a, b in zip(images, truth, strict=True)]
        assert np.all(np.subtract(scores["each"], scores["found"]) > 1), scores
        log = record_of(tmp_path / "each" / "1.npy")["preparation"]
        assert log["capture"]["background"] == f"dark frame {backgrounds / '1.tif'}"
        assert log["psf"]["background"] == "corner"
