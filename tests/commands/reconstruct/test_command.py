"""`thincam reconstruct`: from files to files, in one line what is wrong, and Ctrl-C."""

import json
import re

import numpy as np
import PIL.Image
import pytest
import scipy.ndimage
import skimage.transform
import tifffile
from commands.reconstruct import simulated
from commands.test_cli import one_line, runner

from helpers import shared_data
from thincam_jax.commands import cli
from thincam_jax.commands.reconstruct import run
from thincam_jax.studies.intervals import Intervals


def call(paths, out, *more, psf="psf", capture="capture"):
    given = {"--psf": paths[psf], "--capture": paths.get(capture, capture), "--out": out}
    command = [str(part) for pair in given.items() for part in pair]
    return runner.invoke(cli.app, ["reconstruct", *command, *map(str, more)])


def test_pixels_without_light_are_not_enough(grey, tmp_path):
    """All that holds light counts as saturated: the residual would be 0/0."""
    counts = tifffile.imread(grey["capture"])
    tifffile.imwrite(grey["capture"], np.where(counts > 500, counts, 0).astype(np.uint16))
    options = ("--background", 0, "--bits", 12, "--saturation", 1e-6)
    line = one_line(call(grey, tmp_path / "image.png", *options))
    assert "has a channel without a trusted pixel that holds light" in line
    assert not (tmp_path / "image.png").exists()


def test_links_to_no_file(grey, tmp_path):
    for name, target in (("zero", "/dev/zero"), ("loop", tmp_path / "loop.tif")):
        (tmp_path / f"{name}.tif").symlink_to(target)
        capture = tmp_path / f"{name}.tif"
        result = call(grey, tmp_path / "a.png", capture=capture)
        assert "cannot be read (" in one_line(result)
        assert result.stdout == ""  # no bar begins


def record_of(path):
    return json.loads(path.with_suffix(".json").read_text("utf-8"))


@pytest.fixture
def grey(tmp_path):
    return simulated.grey_files(tmp_path)


def intervals_of(folder, channels=1):
    """A file of intervals: 0.2 of each image's range and 0.4 of its contrast about it."""
    lines = (1.0,) * channels, (0.0,) * channels
    made = Intervals(0.9, 20, "own", *lines, (0.1, 0.0, 0.2), 2.0)
    path = folder / "ridge.json"
    path.write_text(made.as_json(), "utf-8")
    return made, path


def test_intervals_are_written_and_drawn(grey, tmp_path):
    out, (made, path) = tmp_path / "image.png", intervals_of(tmp_path)
    more = ("--bits", 12, "--background", grey["dark"], "--method", "ridge", "--intervals", path)
    result = call(grey, out, *more)
    assert result.exit_code == 0, result.output
    image, lower, upper = (np.load(tmp_path / f"image{n}.npy") for n in ("", "-lower", "-upper"))
    expected = made.of(image.reshape(1, *image.shape[-2:]).astype(float))
    for found, end in zip((lower, upper), expected, strict=True):
        np.testing.assert_allclose(found.ravel(), end.ravel(), rtol=1e-5, atol=1e-6)
    width = upper - lower
    assert width.min() > 0 and width.max() > 1.2 * width.min()
    with PIL.Image.open(tmp_path / "image-width.png") as drawn:
        assert np.asarray(drawn).std() > 1
    record = record_of(out)["intervals"]
    assert record["probability"] == 0.9 and record["pictures"] == 20
    assert record["mean_width"] == pytest.approx(float(width.mean()), rel=1e-4)


def test_intervals_that_do_not_fit_are_told(grey, tmp_path):
    out, (_, path) = tmp_path / "image.png", intervals_of(tmp_path)
    full = call(grey, out, "--intervals", path, "--field", "full")
    assert "leave out --distances and --field" in one_line(full)
    missing = one_line(call(grey, out, "--intervals", tmp_path / "no.json"))
    assert "no.json: is missing; give intervals/METHOD.json" in missing
    path.write_text("{}", "utf-8")
    assert "holds no intervals; give a file" in one_line(call(grey, out, "--intervals", path))
    _, path = intervals_of(tmp_path, channels=3)
    line = one_line(call(grey, out, "--bits", 12, "--background", 0, "--intervals", path))
    assert "has 1 channels, and the intervals are of images of 3" in line
    assert not out.exists()


@pytest.mark.thorough
def test_twelve_bit_capture(grey, tmp_path):
    out = tmp_path / "image.png"
    more = ("--bits", 12, "--background", grey["dark"], "--method", "admm-tv", "--iterations", 80)
    result = call(grey, out, *more)
    assert result.exit_code == 0, result.output
    image = np.load(out.with_suffix(".npy"))
    assert image.dtype == np.float32
    truth = simulated.scene()[1]
    assert simulated.correlation(image, truth) > 0.98
    with PIL.Image.open(out) as shown:
        assert shown.mode == "L"
        np.testing.assert_array_equal(np.array(shown) > 100, _displayed(image) > 100)
    record = record_of(out)
    done = record["reconstruction"]
    assert record["sources"]["psf"] == str(grey["psf"]) and record["sources"]["bits"] == 12
    assert record["preparation"]["capture"]["background"] == f"dark frame {grey['dark']}"
    assert record["files"] == {"png": "image.png", "npy": "image.npy"}
    assert (done["method"], done["tau"], done["iterations_at_most"]) == ("admm_tv", 2.0, 80)
    assert 0 < done["relative_data_residual"] < 0.01
    # 2, and what the spots of the PSF, as fine as pixels, add.
    assert 2.0 < done["noise"]["counts"] < 8.0
    assert done["noise"]["found"].startswith("estimated from the finest detail")
    objectives = [step["objective"] for step in done["history"]]
    assert [step["iteration"] for step in done["history"]] == list(range(0, 81, 10))
    assert objectives[-1] < 1e-2 * objectives[0]
    assert record["image"]["maximum"] == pytest.approx(image.max())
    assert "numpy" in record["environment"]["versions"]
    told = r"image.png: stopped after 80 iterations; the objective still fell by [\d.e-]+ % an iter"
    assert re.search(told, result.stdout)


def _displayed(image):
    """Gamma 2.2 below the percentile that is white."""
    return 255 * np.clip(image / np.percentile(image, 99.9), 0, 1) ** (1 / 2.2)


@pytest.mark.thorough
def test_noise_that_is_given(grey, tmp_path):
    """In counts of a raw pixel; blocks of four have half of it, in parts of the brightest."""
    out = tmp_path / "image.npy"
    more = ("--bits", 12, "--background", grey["dark"], "--iterations", 5, "--noise", 3)
    result = call(grey, out, *more, "--downsample", 2)
    assert "noise 3 counts (given)" in result.stdout
    record = record_of(out)
    brightest = record["preparation"]["capture_divisor"]
    done = record["reconstruction"]
    assert done["noise"] == {"counts": pytest.approx(3), "found": "given"}
    assert done["noise_standard_deviation"] == pytest.approx(1.5 / (4095 * brightest), rel=1e-5)


@pytest.mark.thorough
def test_flip_full_field_and_a_linear_image_alone(grey, tmp_path):
    """A TIFF of floats; 180° turned, with what lies beside the sensor."""
    settings = ("--bits", 12, "--background", 40, "--iterations", 20)
    out, plain = tmp_path / "image.tif", tmp_path / "plain.npy"
    assert call(grey, out, *settings, "--flip", "--field", "full").exit_code == 0
    assert call(grey, plain, *settings, "--gamma", 1).exit_code == 0
    full, middle = tifffile.imread(out), np.load(plain)
    rows, columns = simulated.SHAPE
    assert full.shape == (2 * rows - 1, 2 * columns - 1) and middle.shape == (rows, columns)
    upright = full[::-1, ::-1]
    top, left = (rows - 1) // 2, (columns - 1) // 2
    np.testing.assert_array_equal(upright[top : top + rows, left : left + columns], middle)
    assert not list(tmp_path.glob("image.png")) and not list(tmp_path.glob("plain.png"))
    assert record_of(out)["image"]["turned_by_180_degrees"] is True
    assert record_of(out)["display"] is None


@pytest.mark.thorough
@pytest.mark.parametrize(("psf", "coupling"), [("psf", "joint"), ("grey_psf", "opponent")])
def test_colours(tmp_path, psf, coupling):
    """8-bit PNG with a PSF of one and of three channels; colours are joined by default."""
    paths = simulated.colour_files(tmp_path)
    out = tmp_path / "image.png"
    more = ("--background", simulated.DARK / 16, "--white-balance", "grey-world", "--tau", 1)
    more += () if coupling == "joint" else ("--coupling", coupling)
    result = call(paths, out, *more, psf=psf)
    assert result.exit_code == 0, result.output
    image, truth = np.moveaxis(np.load(out.with_suffix(".npy")), -1, 0), simulated.scene()
    for channel, expected in zip(image, truth, strict=True):
        assert simulated.correlation(channel, expected) > 0.97
    # The colours of the blobs, up to one factor.
    ratios = image[:, 25, 29] / image[0, 25, 29]
    np.testing.assert_allclose(ratios, np.array(simulated.COLOURS[0]) / 0.9, atol=0.1)
    assert record_of(out)["reconstruction"]["variation"]["coupling"] == coupling
    with PIL.Image.open(out) as shown:
        means = np.array(shown).mean(axis=(0, 1))
    assert means.max() < 1.6 * means.min()


@pytest.mark.thorough
def test_mosaic(tmp_path):
    paths = simulated.bayer_files(tmp_path)
    out = tmp_path / "image.png"
    more = ("--bits", 12, "--bayer", "RGGB", "--demosaic", "superpixel")
    result = call(paths, out, *more, "--background", paths["dark"], "--linear", "tif")
    assert result.exit_code == 0, result.output
    image = np.moveaxis(tifffile.imread(out.with_suffix(".tif")), -1, 0)
    assert image.shape == (3, *simulated.SHAPE)
    for channel, expected in zip(image, simulated.scene(), strict=True):
        assert simulated.correlation(channel, expected) > 0.93
    assert record_of(out)["preparation"]["options"]["bayer"] == "RGGB"


class TestFolder:
    NAMES = ("a", "b", "c")

    @pytest.fixture
    def paths(self, tmp_path):
        folder = tmp_path / "captures"
        folder.mkdir()
        return {**simulated.grey_files(folder, self.NAMES), "capture": folder}

    @pytest.mark.thorough
    def test_one_that_fails_is_told_and_the_others_go_on(self, paths, tmp_path):
        """The PSF and the dark frame in the folder are no captures."""
        paths["b"].write_bytes(paths["b"].read_bytes()[:4000])
        out = tmp_path / "out"
        more = ("--bits", 12, "--background", paths["dark"], "--iterations", 20)
        result = call(paths, out, *more)
        line = one_line(result)
        assert line.startswith(f"{paths['b']}: is cut short")
        names = [f"{name}.{suffix}" for name in "ac" for suffix in ("json", "npy", "png")]
        assert sorted(path.name for path in out.iterdir()) == names
        assert [name in result.stdout for name in ("a.png", "b.png", "c.png")] == [1, 0, 1]


def interrupt_at(monkeypatch, name, iteration):
    def interrupted(self, capture, progress):
        if capture == name and progress.iteration >= iteration:
            raise KeyboardInterrupt

    monkeypatch.setattr(run._Bar, "__call__", interrupted)


class TestInterrupt:
    def test_best_image_so_far(self, grey, tmp_path, monkeypatch):
        interrupt_at(monkeypatch, "capture.tif", 30)
        out = tmp_path / "image.png"
        result = call(grey, out, "--bits", 12, "--iterations", 1000)
        assert result.exit_code == 130
        assert result.stderr == f"thincam: interrupted; {out} is the best image so far\n"
        done = record_of(out)["reconstruction"]
        assert (done["status"], done["iterations"]) == ("interrupted", 30)
        image = np.load(out.with_suffix(".npy"))
        assert simulated.correlation(image, simulated.scene()[1]) > 0.9

    def test_before_there_is_one(self, grey, tmp_path, monkeypatch):
        def interrupted(*_, **__):
            raise KeyboardInterrupt

        monkeypatch.setattr("thincam_jax.measured.prepare", interrupted)
        result = call(grey, tmp_path / "image.png", "--bits", 12)
        assert result.exit_code == 130
        assert "nothing of it is kept" in result.stderr
        assert not list(tmp_path.glob("image.*"))


class TestExitCode2:
    @pytest.mark.parametrize(
        ("more", "message"),
        [
            (("--downsample", 100), "downsample = 100 is larger than the image of 60×76 pixels"),
            (("--method", "magic"), "method = 'magic' is unknown; choose one of 'auto'"),
            (("--method", "wiener"), "method 'wiener' needs a model of the camera"),
            (("--method", "poisson"), "method 'poisson' needs raw counts"),
            (("--method", "ridge", "--tau", 2), "method 'ridge' cannot use tau; leave it out"),
            (("--ridge", 1), "method 'admm_tv' cannot use ridge; leave it out, or use 'ridge'"),
            (("--tau", 1e30), "tau = 1e+30: give about 1 to 3, at most 1e+06"),
            (("--bits", 8), "above the 255 of 8 bit"),
            (("--background", 5000), "is black"),
            (("--dead", "none.png"), "none.png: does not exist"),
            (("--coupling", "opponent"), "has 1 channels and coupling 'opponent' is for 3"),
            (("--white-balance", "1,2,3"), "for 1 channel(s)"),
            (("--bayer", "RGGB", "--demosaic", "bilinear", "--capture", "none.tif"), "not exist"),
        ],
    )
    def test_options(self, grey, tmp_path, more, message):
        self.refused(call(grey, tmp_path / "image.png", *more), tmp_path, message)

    def refused(self, result, folder, message):
        assert message in one_line(result)
        assert not list(folder.glob("image*")) and not list(folder.glob(".thincam*"))

    @pytest.mark.parametrize(
        ("which", "change", "message"),
        [
            ("capture", "missing", "capture.tif: does not exist"),
            ("capture", "cut", "capture.tif: is cut short"),
            ("psf", "text", "psf.tif: is not an image that can be read"),
            ("psf", "smaller", "60×70 pixels and the capture"),
            ("capture", "two", "has 2 channels and a PNG shows 1 or 3"),
        ],
    )
    def test_files(self, grey, tmp_path, which, change, message):
        path = grey[which]
        pixels = tifffile.imread(path)
        if change == "missing":
            path.unlink()
        elif change in ("cut", "text"):
            path.write_bytes(path.read_bytes()[:4000] if change == "cut" else b"not an image")
        else:
            planar = "contig" if change == "two" else None
            tifffile.imwrite(path, self.changed(pixels, change), planarconfig=planar)
        self.refused(call(grey, tmp_path / "image.png"), tmp_path, message)

    def changed(self, pixels, change):
        if change == "smaller":
            return np.ascontiguousarray(pixels[:, 6:])
        return np.stack([pixels] * 2, axis=-1)

    @pytest.mark.parametrize(
        ("out", "message"),
        [
            ("psf.tif/image.png", "psf.tif: is no folder; give another"),
            ("image.jpg", "give one of these suffixes"),
            ("psf.tif", "psf.tif: is read as an input and would be overwritten"),
            ("/proc/image.png", "/proc: cannot be written into"),
        ],
    )
    def test_output(self, grey, tmp_path, out, message):
        before = {path: path.read_bytes() for path in grey.values()}
        self.refused(call(grey, tmp_path / out), tmp_path, message)
        assert {path: path.read_bytes() for path in grey.values()} == before


@pytest.mark.thorough
def test_hand(tmp_path):
    """A real capture (skipped where it is absent): an open hand, as its authors show it."""
    folder = shared_data("diffusercam-hand")
    paths = {"psf": folder / "psf_sample.tif", "capture": folder / "rawdata_hand_sample.tif"}
    out = tmp_path / "hand.png"
    result = call(paths, out, "--downsample", 8, "--method", "admm-tv")
    assert result.exit_code == 0, result.output
    done = record_of(out)["reconstruction"]
    assert done["status"] == "converged" and done["relative_data_residual"] <= 0.01
    image = np.load(out.with_suffix(".npy"))
    assert image.shape == (150, 200)
    with PIL.Image.open(folder / "reference_admm5_notebook_output.png") as figure:
        panel = np.array(figure.convert("L"), dtype=float)[23:239, 34:323]
    small = skimage.transform.resize(image, panel.shape, anti_aliasing=True)
    assert simulated.correlation(small, panel) >= 0.97
    with PIL.Image.open(out) as shown:
        pixels = np.array(shown)
    assert np.median(pixels) < 10 and pixels[70, 102] > 180  # black around, bright the palm


@pytest.mark.thorough
def test_hand_is_explained_as_well_as_before(tmp_path):
    """At four times the pixels, as docs/guide/real_captures.md has it."""
    folder = shared_data("diffusercam-hand")
    paths = {"psf": folder / "psf_sample.tif", "capture": folder / "rawdata_hand_sample.tif"}
    out = tmp_path / "hand.npy"
    assert call(paths, out, "--downsample", 4).exit_code == 0
    done = record_of(out)["reconstruction"]
    assert done["relative_data_residual"] == pytest.approx(0.0055, rel=0.1)


def check(paths, *more, psf="psf"):
    given = ["--psf", paths[psf], "--capture", paths["capture"], "--background", paths["dark"]]
    return runner.invoke(cli.app, ["calibrate", "check", *map(str, given), *map(str, more)])


@pytest.fixture
def small(grey, tmp_path):
    """The files, with a PSF that was measured 3 % too small."""
    grey["small"] = tmp_path / "small.tif"
    light = tifffile.imread(grey["psf"]).astype(float)
    middle = (np.array(light.shape) - 1) / 2
    start = middle - middle / 0.97
    shrunk = scipy.ndimage.affine_transform(light, [1 / 0.97] * 2, start, mode="nearest")
    tifffile.imwrite(grey["small"], np.round(shrunk).clip(0, 4095).astype(np.uint16))
    return grey


@pytest.mark.thorough
def test_a_psf_of_another_size_is_refined_as_advised(small, tmp_path):
    """By `thincam reconstruct --refine`; a right one stays."""
    more, truth = ("--bits", 12, "--background", small["dark"]), simulated.scene()[1]
    given, refined, right = (tmp_path / f"{name}.npy" for name in ("given", "refined", "right"))
    result = call(small, given, *more, psf="small")
    assert "times the size; refine it (--refine" in result.stdout, result.output
    result = call(small, refined, *more, "--refine", psf="small")
    assert "; PSF refined: scale 1.03" in result.stdout, result.output
    record = record_of(refined)
    assert record["refinement"]["is_changed"] and not record["examination"]
    assert abs(record["refinement"]["values"]["scale"] - 1 / 0.97) < 0.005
    before, after = (simulated.correlation(np.load(one), truth) for one in (given, refined))
    assert 1 - after < 0.7 * (1 - before)
    assert "; PSF fits as it is" in call(small, right, *more, "--refine").stdout
    assert not record_of(right)["refinement"]["is_changed"]


def test_what_cannot_be_refined_is_told(grey, tmp_path):
    line = one_line(call(grey, tmp_path / "a.png", "--refine", "--distances", "60mm,80mm,100mm"))
    assert line.endswith("--refine is of one PSF; leave out --distances")
    more = ("--refine", "--downsample", 2, "--bits", 12, "--background", grey["dark"])
    assert "--refine: captures have (30, 38) pixels" in one_line(
        call(grey, tmp_path / "a.png", *more)
    )


@pytest.mark.thorough
def test_a_refined_psf_is_written_and_can_be_used(small, tmp_path):
    grey, out = small, tmp_path / "refined.tif"
    bits = ("--bits", 12, "--downsample", 1)
    result = check(grey, *bits, "--refine", out, psf="small")
    assert result.exit_code == 0, result.output
    assert f"written: --psf {out} --psf-background 0" in result.stdout
    grey["refined"] = out
    followed = check(grey, *bits, "--psf-background", 0, psf="refined")
    assert followed.exit_code == 0 and "your PSF fits" in followed.stdout, followed.output


def test_a_refined_psf_needs_a_linear_file(grey, tmp_path):
    line = one_line(check(grey, "--refine", tmp_path / "refined.png"))
    assert line.endswith("refined.png: give a file .npy or .tif")


def test_psf_has_its_own_bits_corner_and_pixels(grey, tmp_path):
    """The PSF on pixels half as large, in 16 bits, with the dark corner elsewhere."""
    fine = np.kron(tifffile.imread(grey["psf"]), np.ones((2, 2), np.uint16)) * 16
    grey["fine"] = tmp_path / "fine.tif"
    tifffile.imwrite(grey["fine"], fine)
    out = tmp_path / "image.npy"
    options = ("--bits", 12, "--psf-bits", 16, "--background", simulated.DARK)
    options += ("--psf-background", 16 * simulated.DARK, "--corner", "2:9", "--psf-scale", 0.5)
    result = call(grey, out, *options, psf="fine")
    assert result.exit_code == 0, result.output
    told = record_of(out)
    assert told["preparation"]["psf"]["bits"] == 16
    assert told["preparation"]["capture"]["bits"] == 12
    assert told["preparation"]["options"]["corner"] == [2, 9]
    expected = simulated.scene()[1]
    assert simulated.correlation(np.load(out), expected) > 0.9


def test_advice_on_channels_is_in_options_and_can_be_followed(grey, tmp_path):
    tifffile.imwrite(grey["psf"], np.stack([tifffile.imread(grey["psf"])] * 3, axis=-1))
    advice = "or average the PSF's with --psf-channels mean"
    small = ("--downsample", 2)  # refused, but later
    for result in (check(grey, *small), call(grey, tmp_path / "image.npy", "--background", 40)):
        assert one_line(result).endswith(advice)
    followed = check(grey, *small, "--psf-background", 40, *advice.split()[-2:])
    assert "give at least 32 a side" in one_line(followed)


@pytest.mark.thorough
def test_crop_of_the_captures_with_the_whole_psf(grey, tmp_path):
    out = tmp_path / "image.npy"
    more = ("--background", grey["dark"], "--bits", 12, "--method", "ridge")
    result = call(grey, out, "--crop", "8:49,5:70", *more)
    assert result.exit_code == 0, result.output
    assert record_of(out)["preparation"]["options"]["crop"] == [[8, 49], [5, 70]]
    assert simulated.correlation(np.load(out), simulated.scene()[1, 8:49, 5:70]) > 0.9
    line = one_line(call(grey, out, "--crop", "8:49", *more))
    assert line.startswith("--crop 8:49: give the first row and the one after the last")


@pytest.mark.parametrize("corner", ["5-15", "7:5"])
def test_wrong_corner_is_one_line(grey, tmp_path, corner):
    line = one_line(call(grey, tmp_path / "image.npy", "--corner", corner))
    assert line == f"--corner {corner}: give the first pixel and the one after the last, as 5:15"
