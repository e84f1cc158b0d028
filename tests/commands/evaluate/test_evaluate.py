"""The commands `thincam evaluate` and `thincam dataset info`, over simulated files."""

import contextlib
import csv
import json
import re
import warnings

import numpy as np
import PIL.Image
import pytest
from commands.reconstruct import simulated
from commands.test_cli import call, called, one_line

from thincam_jax.commands.evaluate import pair, run
from thincam_jax.commands.evaluate.config import EvaluationConfig
from thincam_jax.commands.evaluate.pair import opened, reconstructed
from thincam_jax.measured import Preparation
from thincam_jax.measured.layouts import open_pairs
from thincam_jax.studies.agreement import agreement
from thincam_jax.studies.intervals import Intervals, PixelSample

LINEAR = ("--bits", 12, "--background", simulated.DARK)


def write_pairs(folder, count=4, shape=simulated.SHAPE):
    """captures/ of 12 bit, truths/ in light, and psf.tif beside."""
    light = simulated.psf(shape)
    for name in ("captures", "truths"):
        (folder / name).mkdir(parents=True)
    simulated.write_tiff(folder / "psf.tif", simulated.counts(light, 3))
    for n in range(count):
        scene = simulated.scene(shape, 2 * n)[1:2]
        counts = simulated.counts(simulated.capture(scene, light)[0], 10 + n)
        simulated.write_tiff(folder / "captures" / f"im{n}.tif", counts)
        np.save(folder / "truths" / f"im{n}.npy", scene[0].astype(np.float32))
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_pairs(tmp_path / "set")


@pytest.fixture
def fast(monkeypatch):
    """In place of reconstructions: the truths with noise of their own, by method and name."""

    def noisy(config, method, given):
        others = {"residual": 0.1, "status": "converged", "findings": []}
        if given.name == "im3":
            warnings.warn("a corner is not dark", stacklevel=1)
        seed = sum(map(ord, method + given.name))
        noise = np.random.default_rng(seed).normal(0, 0.1, given.truth.shape).astype(np.float32)
        image = given.truth + noise
        pixels = PixelSample.of(3 * image, given.truth, 64).as_lists()
        return agreement(image, given.truth), 0.5, {**others, "pixels": pixels}

    monkeypatch.setattr(pair, "reconstructed", noisy)


@pytest.fixture
def done(monkeypatch):
    """Tasks are done in this process, which is listed; with `stop` set, only so many of them."""
    tasks, stop = [], []

    def outcomes(function, arguments):
        for name, given in arguments.items():
            if stop and len(tasks) >= stop[0]:
                raise KeyboardInterrupt
            tasks.append(name)
            yield name, function(*given)

    work = lambda *_: contextlib.nullcontext(outcomes)  # noqa: E731
    monkeypatch.setattr(run, "workers_of", work)
    outcomes.stop, outcomes.tasks = stop, tasks
    return outcomes


def rows_of(out):
    """Rows of the table without the seconds."""
    with open(out / "table.csv", encoding="utf-8") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


class TestSameImage:
    """As `thincam reconstruct` makes it of the same files."""

    @pytest.mark.thorough
    def test_of_files(self, folder, tmp_path):
        dark = tmp_path / "dark.tif"
        simulated.write_tiff(dark, np.full(simulated.SHAPE, simulated.DARK))
        options = ("--bits", 12, "--background", dark, "--downsample", 2, "--iterations", 20)
        files = "--psf", folder / "psf.tif", "--capture", folder / "captures" / "im1.tif"
        assert call("reconstruct", *files, *options, "--out", tmp_path / "x.npy").exit_code == 0
        config = EvaluationConfig(
            name="a",
            title="a",
            path=str(folder),
            split="all",
            background=str(dark),
            bits=12,
            preparation=Preparation(downsample=2),
            iterations=20,
            fit="none",
        ).model_dump_json()
        found, _, others = reconstructed(config, "admm_tv", opened(config)[1][1])
        np.testing.assert_array_equal(found.image[0], np.load(tmp_path / "x.npy"))
        record = json.loads((tmp_path / "x.json").read_text())
        assert others["residual"] == record["reconstruction"]["relative_data_residual"]

    def test_of_published_captures(self, tmp_path):
        """Upside down, blue first, PSF of twice the pixels: upright and red first."""
        shape = (40, 48)
        light = simulated.psf(shape)
        for name in ("diffuser", "lensed"):
            (tmp_path / name).mkdir()
        fine = np.kron(simulated.counts(light, 3) / 16, np.ones((2, 2)))
        PIL.Image.fromarray(np.stack([fine] * 3, -1).astype(np.uint8)).save(tmp_path / "psf.tiff")
        scene = np.moveaxis(simulated.scene(shape), 0, -1)
        seen = np.moveaxis(simulated.capture(simulated.scene(shape), light), 0, -1)
        np.save(tmp_path / "diffuser" / "im1.npy", (seen / seen.max())[..., ::-1].astype("f4"))
        np.save(tmp_path / "lensed" / "im1.npy", scene[..., ::-1].astype("f4"))
        options = ("--iterations", 20, "--psf-background", 2, "--background", 0)
        files = "--psf", tmp_path / "psf.tiff", "--capture", tmp_path / "diffuser" / "im1.npy"
        published = ("--psf-scale", 0.5, "--psf-channels", "mean")
        called("reconstruct", *files, *options, *published, "--out", tmp_path / "x.npy")
        config = EvaluationConfig(
            name="a",
            title="a",
            path=str(tmp_path),
            split="all",
            background="0",
            psf_background="2",
            preparation=Preparation(psf_channels=open_pairs(tmp_path).psf_channels),
            iterations=20,
            fit="none",
        ).model_dump_json()
        found, *_ = reconstructed(config, "admm_tv", opened(config)[1][0])
        expected = np.moveaxis(np.load(tmp_path / "x.npy"), -1, 0)[::-1, ::-1]
        np.testing.assert_allclose(found.image, expected, atol=1e-4 * expected.max())
        np.testing.assert_array_equal(found.truth, np.moveaxis(scene, -1, 0)[:, ::-1].astype("f4"))


class TestEvaluate:
    def run(self, folder, out, *more):
        return call("evaluate", folder, *LINEAR, "--iterations", 20, "--out", out, *more)

    def test_table_and_page(self, folder, tmp_path, done, fast):
        out = tmp_path / "out"
        result = self.run(folder, out, "--method", "admm-tv", "--method", "ridge")
        assert result.exit_code == 0, result.stderr
        rows = rows_of(out)
        assert [row["name"] for row in rows] == [f"im{n}" for n in range(4) for _ in "ab"]
        metrics = json.loads((out / "metrics.json").read_text())
        first, second = metrics["scores"]
        mean = np.mean([float(r["psnr_db"]) for r in rows if r["method"] == "admm_tv"])
        assert first["psnr_db"]["mean"] == pytest.approx(mean)
        gains = [
            float(b["psnr_db"]) - float(a["psnr_db"])
            for a, b in zip(rows[::2], rows[1::2], strict=True)
        ]
        assert second["beside"]["mean"] == pytest.approx(np.mean(gains))
        assert first["worst"] < first["median"] < first["best"]
        page = (out / "report.html").read_text()

        assert "admm_tv, im3: a corner is not dark" in page and "im2: a corner" not in page
        files = {file.name for file in (out / "images").iterdir()}
        shown = ("capture", "truth", "admm-tv", "ridge")
        assert files == {
            f"{word}-{what}.png" for word in ("worst", "median", "best") for what in shown
        }
        order = sorted((float(r["psnr_db"]), r["name"]) for r in rows if r["method"] == "admm_tv")
        assert f"Worst: {order[0][1]}" in page and f"Best: {order[-1][1]}" in page
        assert np.asarray(PIL.Image.open(out / "images" / "best-truth.png")).max() == 231  # of 0.8

    def test_intervals_of_twelve_pairs(self, folder, tmp_path, done, fast):
        """Each pair's are calibrated by others; those of all are kept, for images of the camera."""
        for place, end in (("captures", "tif"), ("truths", "npy")):
            for n in range(4, 12):
                source = folder / place / f"im{n % 4}.{end}"
                (folder / place / f"im{n}.{end}").write_bytes(source.read_bytes())
        out = tmp_path / "out"
        assert self.run(folder, out, "--method", "ridge", "--limit", 11).exit_code == 0
        (scores,) = json.loads((out / "metrics.json").read_text())["scores"]
        assert scores["covered"] is None and not list(out.glob("intervals/*"))
        column = re.compile("in intervals.{0,9}of 90 %", re.DOTALL)
        assert not column.search((out / "report.html").read_text())
        assert self.run(folder, out, "--method", "ridge").exit_code == 0
        (scores,) = json.loads((out / "metrics.json").read_text())["scores"]
        assert 0.9 < scores["covered"]["mean"] <= 1
        # Noise of 0.1, of whose pixels nine pictures leave at most one out on average.
        assert 0.3 < scores["width"]["mean"] < 1
        assert column.search((out / "report.html").read_text())
        found = Intervals.load(out / "intervals" / "ridge.json")
        assert found.pictures == 12 and found.levels == "own" and found.probability == 0.9

    def test_goes_on(self, folder, tmp_path, done, fast):
        out, method = tmp_path / "out", ("--method", "ridge")
        done.stop.append(3)
        assert self.run(folder, out, *method).exit_code == 130
        done.stop.clear()
        assert len(done.tasks) == 3
        assert self.run(folder, out, *method).exit_code == 0
        assert len(done.tasks) == 4 + 3  # the fourth, and three for their images
        whole = tmp_path / "whole"
        assert self.run(folder, whole, *method).exit_code == 0
        assert rows_of(out) == rows_of(whole)

    def test_only_what_changed_is_done_anew(self, folder, tmp_path, done, fast):
        out, method = tmp_path / "out", ("--method", "ridge")
        self.run(folder, out, *method, "--limit", 2)
        del done.tasks[:]
        np.save(folder / "truths" / "im1.npy", np.load(folder / "truths" / "im0.npy"))
        held = out / "pairs" / "ridge" / "000000-im0.json"
        held.write_text(held.read_text().replace("2", "3", 1))  # damaged
        self.run(folder, out, *method)
        assert sorted(done.tasks[:4]) == [f"ridge/00000{n}-im{n}" for n in range(4)]
        del done.tasks[:]
        self.run(folder, out, *method, "--method", "fista")
        assert {name.split("/")[0] for name in done.tasks[:4]} == {"fista"}

    def test_a_pair_that_fails(self, folder, tmp_path, done, fast):
        (folder / "captures" / "im2.tif").write_bytes(b"II*\0")
        result = self.run(folder, tmp_path / "out", "--method", "ridge")
        assert result.exit_code == 0 and len(rows_of(tmp_path / "out")) == 3
        (line,) = result.stderr.splitlines()
        assert line.startswith("thincam: 1 of 4 images failed; the first (ridge/000002-im2): ")
        assert "im2.tif" in (tmp_path / "out" / "report.html").read_text()

    def test_place_and_levels(self, folder, tmp_path, done):
        """A gain is stated; a truth that is moved is found by --shift."""
        out = tmp_path / "out"
        truth = np.load(folder / "truths" / "im0.npy")
        np.save(folder / "truths" / "im0.npy", np.roll(truth, (1, -2), axis=(0, 1)))
        self.run(folder, out, "--shift", 3, "--fit", "gain", "--limit", 1)
        (row,) = rows_of(out)
        assert row["shift"] == "1 -2" and row["offset"] == "0.0" and float(row["psnr_db"]) > 26

    def test_published_figures(self, folder, tmp_path, done, fast):
        file = tmp_path / "published.yaml"
        entry = "{dataset: D, method: ADMM, psnr_db: 12.7, protocol: maxima, source: page 5}"
        file.write_text(f"- {entry}\n")
        self.run(folder, tmp_path / "out", "--limit", 1, "--published", file)
        page = (tmp_path / "out" / "report.html").read_text()
        assert re.search(r"12\.7.*\n?.*maxima.*page 5", page)
        file.write_text("- {dataset: D, method: ADMM, psnr_db: 12.7}\n")
        result = self.run(folder, tmp_path / "b", "--limit", 1, "--published", file)
        assert one_line(result).endswith("published.yaml: entry 1 has no protocol, source")


class TestRefused:
    @pytest.mark.parametrize(
        ("options", "part"),
        [
            (("--method", "wiener"), "--method wiener: is unknown here; choose from auto, admm-tv"),
            (
                ("--method", "pnp", "--tau", 1),
                "--tau is used by admm-tv, fista, auto; leave it out",
            ),
            (("--method", "ridge", "--method", "ridge"), "has one twice"),
            (("--split", "test"), "has no split 'test'; there are all$"),
            (("--psf", "psfs.tif"), "psfs.tif: does not exist; give an image, or a folder of"),
            (("--truth-area", "5:2,1:3"), "--truth-area 5:2,1:3: give the first row"),
        ],
    )
    def test_options(self, folder, tmp_path, options, part):
        result = call("evaluate", folder, *options, "--out", tmp_path / "out")
        assert result.exit_code == 2 and part in one_line(result) + "$"
        assert not (tmp_path / "out").exists()

    def test_truths_of_another_shape(self, folder, tmp_path):
        """Before any image is reconstructed, and not where somebody says what they cover."""
        for truth in folder.glob("truths/*.npy"):
            np.save(truth, np.load(truth)[:-6])
        result = call("evaluate", folder, *LINEAR, "--out", tmp_path / "out")
        assert "give what they cover: --truth-area" in one_line(result)
        assert not (tmp_path / "out").exists()

    def test_no_psf(self, folder, tmp_path):
        (folder / "psf.tif").unlink()
        result = call("evaluate", folder, "--out", tmp_path / "out")
        assert "no PSF lies beside the captures: give --psf" in one_line(result)

    def test_other_options_in_a_folder(self, folder, tmp_path, done, fast):
        out = tmp_path / "out"
        assert call("evaluate", folder, "--limit", 1, "--out", out).exit_code == 0
        result = call("evaluate", folder, "--limit", 1, "--fit", "none", "--out", out)
        assert "holds a comparison of another configuration" in one_line(result)


def test_info(folder):
    result = called("dataset", "info", folder)
    text = " ".join(result.stdout.replace("│", " ").split())
    for part in ("two folders", "60×76 pixels", "16 bit", "all, 4 pairs", "not stated"):
        assert part in text
    wrong = call("dataset", "info", folder / "truths")
    assert "known layouts are: " in one_line(wrong)
