"""Runs: what they leave behind, that they repeat and go on after an interruption; their report."""

import gc
import json
import re
import shutil
from dataclasses import asdict

import numpy as np
import pytest
import skimage.io
from commands.pages import assert_says_its_result
from commands.study import tiny

from thincam_jax._core.precision import double_precision, is_double
from thincam_jax.commands import run_folder
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import RunFolder, origin_of
from thincam_jax.commands.study import run as running
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.run import run_study
from thincam_jax.studies.evaluate import Resolved, Scores, evaluate_method, take
from thincam_jax.studies.result import (
    MethodScores,
    ResponseLimits,
    StudyScores,
    findings,
    method_response,
)
from thincam_jax.studies.study import Published

EVIL = "<script>alert(1)</script> & \"quoted\" <img src='http://example.org/x.png'>"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("tiny")


@pytest.fixture(scope="module")
def taken():
    """Of the uninterrupted run: exposures, channels and noise of all its captures."""
    return []


@pytest.fixture(scope="module")
def whole(home, taken):
    """One uninterrupted run: the study, folder, scores, the texts of its progress."""
    quoted = EVIL.replace("'", "''")
    told = (f"title='{quoted}'", f"notes=['{quoted}', A second note.]")
    study, texts = tiny.built(home, *told), tiny.Told()
    folder = RunFolder(home / "whole")
    with pytest.MonkeyPatch.context() as patch:
        counting = counted(patch)
        scores = run_study(study, folder, texts)
        taken.extend(counting)
    return study, folder.path, scores, texts


def test_metrics_hold_every_method_and_target(whole):
    _, path, scores, _ = whole
    metrics = json.loads((path / "metrics.json").read_text("utf-8"))
    assert metrics == asdict(scores)
    assert metrics["study"] == "tiny"
    assert metrics["seed"] == 3
    assert list(metrics["methods"]) == ["conventional", "pairs"]
    for method in metrics["methods"].values():
        assert method["captures"] == 4
        assert list(method["targets"]) == ["chart", "picture"]
        for target in method["targets"].values():
            assert 10 < target["psnr_db"] < 40
            assert 0.2 < target["ssim"] < 1
            assert target["object_pixel_mm"] == pytest.approx(0.04 * 100 / 3, abs=1e-6)
        assert method["targets"]["picture"]["resolved"] is None
        picture = method["targets"]["picture"]["psnr_db"]
        assert method["mean_psnr_of_pictures_db"] == picture  # the chart is not among them
        # The zones end at 8.0 cycles/mm, at 12.5 the pixels do.
        assert 7 < method["limits"]["cut_off_cycles_per_mm"] <= 12.5
        assert method["limits"]["cut_off_object_mm"] == pytest.approx(
            100 / 3 / method["limits"]["cut_off_cycles_per_mm"], abs=1e-3
        )
    assert metrics["methods"]["conventional"]["published"] == {
        "psnr_db": 20.3,
        "resolved_object_mm": 4.6,
        "limit_cycles_per_mm": 10.8,
    }
    assert set(metrics["methods"]["pairs"]["published"].values()) == {None}


def test_reconstruction_is_upright(whole):
    """The picture's red blob is up and to the left, the green one down and to the right."""
    for method in ("conventional", "pairs"):
        image = skimage.io.imread(whole[1] / "images" / f"picture--{method}.png").astype(float)
        assert image.shape[2] == 3
        for channel, blob in enumerate([(12, 15), (30, 40), (20, 45)]):
            brightest = np.unravel_index(np.argmax(image[..., channel]), image.shape[:2])
            assert np.linalg.norm(np.subtract(brightest, blob)) < 5


@pytest.mark.thorough
def test_same_seed_same_bytes_other_seed_other_noise(whole, home):
    again = RunFolder(home / "again")
    run_study(whole[0], again, tiny.ignore)
    bytes_of = (whole[1] / "metrics.json").read_bytes()
    assert (again.path / "metrics.json").read_bytes() == bytes_of
    other = RunFolder(home / "other")
    metrics = asdict(run_study(tiny.built(home, "seed=4"), other, tiny.ignore))
    for name, method in metrics["methods"].items():
        for target, found in method["targets"].items():
            before = whole[2].methods[name].targets[target].psnr_db
            assert found["psnr_db"] != before
            assert found["psnr_db"] == pytest.approx(before, abs=4)  # noise, no other physics


def counted(monkeypatch):
    """The exposures, channels and noise of all captures taken from here on."""
    taken = []

    def counting(study, exposure, target):
        found = take(study, exposure, target)
        taken.append((exposure, len(found.image), found.image.tobytes()))
        return found

    monkeypatch.setattr(running, "take", counting)
    return taken


@pytest.mark.thorough
def test_interrupted_run_goes_on_where_it_stopped(whole, home, monkeypatch):
    study, path, scores, texts = whole
    folder = RunFolder(home / "interrupted")
    taken = counted(monkeypatch)

    def interrupt(text, _):
        if text.startswith("picture: capture 3"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, folder, interrupt)
    assert len(taken) == tiny.CAPTURES + 2
    assert folder.finished("chart") is not None
    assert folder.finished("picture") is None
    assert not (folder.path / "metrics.json").exists()
    assert not list(folder.path.rglob("*.partial*"))

    taken.clear()
    progress = tiny.Told()
    assert run_study(study, folder, progress) == scores
    assert len(taken) == tiny.CAPTURES
    assert {channels for _, channels, _ in taken} == {3}  # the chart, in grey, was not redone
    assert progress == [text for text in texts if not text.startswith("chart: ")]
    assert progress.total == len(progress)
    assert (folder.path / "metrics.json").read_bytes() == (path / "metrics.json").read_bytes()
    # The chart's figures of the first part are in the report of the second.
    assert (folder.path / "figures" / "contrast.png").exists()


def test_captures_that_methods_share_are_taken_once(whole, taken):
    for channels in (1, 3):
        settings = [(s.beta, round(s.phase, 6)) for s, c, _ in taken if c == channels]
        quarter = round(np.pi / 2, 6)
        phases = [0.0, quarter, round(np.pi, 6), round(3 * np.pi / 2, 6)]
        assert settings == [(25.0, p) for p in phases] + [(21.0, 0.0), (21.0, phases[3])]
    assert len({image for _, _, image in taken}) == len(taken)  # each has noise of its own


@pytest.mark.parametrize("text", ["5", '{"metrics": NaN}', "{}", '{"a": "\\ud800"}'])
def test_damaged_result_of_a_target_is_done_again(home, whole, text):
    folder = RunFolder(home / "damaged")
    folder.claim(whole[0].config)
    folder.finish("chart", {"metrics": {}, "contrasts": {}})
    assert folder.finished("chart") == {"metrics": {}, "contrasts": {}}
    path = folder.path / "targets" / "chart.json"
    changed = path.read_text("utf-8").replace('"contrasts": {}', '"contrasts": {"a": 1}')
    for damaged in (text, changed, "[" * 100_000):
        path.write_text(damaged, encoding="utf-8")
        assert folder.finished("chart") is None


class TestInputs:
    """What a resumed run takes up came from the same files, package and precision."""

    def claimed(self, tmp_path):
        folder, config = RunFolder(tmp_path / "out"), tiny.study(tmp_path)
        folder.claim(config)
        folder.finish("chart", {"metrics": {}})
        folder.claim(config)
        assert folder.finished("chart") == {"metrics": {}}
        return folder, config

    def test_another_picture(self, tmp_path):
        folder, config = self.claimed(tmp_path)
        skimage.io.imsave(tmp_path / "picture.png", np.eye(48, dtype=np.uint8) * 255)
        assert folder.changed(config) == [str(tmp_path / "picture.png")]
        folder.claim(config)
        assert folder.finished("chart") is None

    def test_another_package(self, tmp_path, monkeypatch):
        folder, config = self.claimed(tmp_path)
        monkeypatch.setattr(run_folder, "installed", lambda names: dict.fromkeys(names, "0.0"))
        assert folder.changed(config) == ["thincam_jax"]
        folder.claim(config)
        assert folder.finished("chart") is None

    def test_another_precision(self, tmp_path):
        folder, config = self.claimed(tmp_path)
        with double_precision(not is_double()):
            assert folder.changed(config) == ["precision"]

    def test_all_files_of_a_folder_count(self, tmp_path):
        (tmp_path / "images").mkdir()
        (tmp_path / "images" / "a.png").write_bytes(b"a")
        mask = tiny.study(tmp_path).mask.model_copy(update={"path": str(tmp_path / "images")})
        before = origin_of(mask)
        assert list(before)[2:] == [str(tmp_path / "images" / "a.png")]
        (tmp_path / "images" / "b.png").write_bytes(b"b")
        assert len(origin_of(mask)) == len(before) + 1


def test_folder_of_another_study_is_refused(whole, home):
    before = (whole[1] / "metrics.json").read_bytes()
    other = tiny.built(home, "seed=5")
    with pytest.raises(ConfigError, match="holds a run of another configuration") as caught:
        run_study(other, RunFolder(whole[1]), tiny.ignore)
    assert "delete this one" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (whole[1] / "metrics.json").read_bytes() == before


def test_folder_with_other_files_is_refused_untouched(home, whole):
    foreign = home / "foreign"
    (foreign / "targets").mkdir(parents=True)
    for name in ("metrics.json", "report.html", "targets/mine.json"):
        (foreign / name).write_text("mine", encoding="utf-8")
    before = sorted(foreign.rglob("*"))
    with pytest.raises(ConfigError, match="not empty and holds no run; give a new folder"):
        run_study(whole[0], RunFolder(foreign), tiny.ignore)
    assert sorted(foreign.rglob("*")) == before
    assert all(p.read_text("utf-8") == "mine" for p in before if p.is_file())


class TestCheck:
    """Faults that are found before the first capture: one line each, which names the field."""

    def line(self, config):
        with pytest.raises(ConfigError) as caught:
            build_study(config)
        (line,) = str(caught.value).split("\n")
        return line

    # Some decoders leave a damaged file open for the collector.
    @pytest.mark.filterwarnings("ignore::ResourceWarning")
    @pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
    def test_unreadable_image(self, tmp_path):
        config = tiny.study(tmp_path)
        (tmp_path / "picture.png").write_bytes(b"\x89PNG but no more")
        line = self.line(config)
        assert "targets[1]: " in line
        assert "cannot be read as an image" in line
        gc.collect(1)

    def test_uniform_image(self, tmp_path):
        config = tiny.study(tmp_path)
        black = np.zeros((45, 60), np.uint8)
        skimage.io.imsave(tmp_path / "picture.png", black, check_contrast=False)
        assert "targets[1]: the image is uniform" in self.line(config)

    @pytest.mark.parametrize("shape", ["[6, 64]", "[48, 41]"])
    def test_sensor_of_too_few_pixels(self, shape, tmp_path):
        line = self.line(tiny.study(tmp_path, f"sensor.shape={shape}"))
        assert "sensor.shape: " in line
        assert "give at least 7×42" in line

    def test_object_of_a_few_pixels(self, tmp_path):
        with pytest.raises(ConfigError) as caught:
            tiny.built(tmp_path, "object.width=7 mm")
        first, second = str(caught.value).split("\n")
        assert "targets[0]: 'conventional' reconstructs it on 6×6 pixels" in first
        assert "targets[1]: 'conventional' reconstructs it on 4×6 pixels" in second


@pytest.mark.thorough
def test_pictures_alone_give_a_report(tmp_path, home):
    """Without a chart nothing is resolved; a target may be called like one of the figures."""
    only = f"targets=[{{name: mtf, kind: file, path: {tmp_path / 'picture.png'}}}]"
    folder = RunFolder(tmp_path / "out")
    scores = run_study(tiny.built(tmp_path, only), folder, tiny.ignore)
    for method in scores.methods.values():
        assert method.targets["mtf"].resolved is None and method.resolved_mm is None
    assert not (folder.path / "figures" / "contrast.png").exists()
    figures = {(folder.path / "figures" / n).read_bytes() for n in ("mtf.png", "captures-mtf.png")}
    assert len(figures) == 2
    assert (folder.path / "report.html").exists()


@pytest.mark.thorough
def test_smallest_sensor_that_is_let_through_gives_finite_results(tmp_path):
    study = tiny.built(tmp_path, "sensor.shape=[7, 42]", "seed=1")
    method, target = study.methods[1], study.targets[0]
    captures = {exposure: take(study, exposure, target) for exposure in method.exposures}
    assert np.isfinite(evaluate_method(study, method, target, captures).scores.psnr_db)
    assert np.isfinite(method_response(study, method).limits.cut_off_cycles_per_mm)


@pytest.fixture
def run(whole, tmp_path):
    """Study, folder, scores and report of a copy of the run."""
    study, path, scores, _ = whole
    shutil.copytree(path, tmp_path / "copy")
    return study, RunFolder(tmp_path / "copy"), scores, assert_says_its_result(path)


def test_no_reference_outside_the_folder(run):
    _, folder, _, page = run
    tags = " ".join(re.findall(r"<[^>]+>", page))
    sources = re.findall(r"""(?:src|href|srcset|data|action)\s*=\s*["']?([^"'\s>]+)""", tags)
    within = [source for source in sources if source.startswith("#")]
    assert all(f'id="{source[1:]}"' in page for source in within)  # the contents
    held = [source for source in sources if source.startswith("data:image/webp;base64,")]
    # Of each target the capture, scene and methods, all but the first enlarged; three figures.
    assert len(held) == 2 * 7 + 3
    beside = [source for source in sources if source not in (*within, *held)]
    assert beside and all((folder.path / source).is_file() for source in beside)
    tags = set(re.findall(r"<\s*([a-z]\w*)", page))
    assert not tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert not re.search(r"url\(|@import|file://", page)


def test_text_of_the_configuration_is_escaped(run):
    page = run[3]
    assert "<script" not in page
    assert "<img src='http" not in page
    # Title, heading, note and the configuration at the end.
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt; &amp; ") >= 4
    assert "<p>A second note.</p>" in page


def method(psnr, published_psnr, resolved, published_resolved):
    chart = None if resolved is None else Resolved(0, 1, resolved, 1.0)
    return MethodScores(
        4,
        psnr,
        ResponseLimits(None, None, 9.0, 3.7),
        {"picture": Scores(20.0, 0.5, 0.1), "chart": Scores(20.0, 0.5, 0.1, chart)},
        Published(published_psnr, published_resolved),
    )


def test_findings_say_how_the_numbers_lie_to_the_published_ones(run):
    methods = {
        "better": method(24.54, 20.3, 1.0, 1.6),
        "worse": method(18.0, 20.0, 4.0, 3.2),
        "equal": method(None, None, 2.0, 2.02),
        "alone": method(20.0, None, None, None),
    }
    assert findings(run[0], StudyScores("tiny", 3, methods, [])) == [
        "Beside “better”, which resolves 1.00 mm, equal resolves a line pair of 2.00 mm.",
        "better: 24.5 dB on average over the pictures, published 20.3 dB (+4.2 dB).",
        "better: resolves a line pair of 1.00 mm on the object, published 1.60 mm: finer.",
        "worse: 18.0 dB on average over the pictures, published 20.0 dB (-2.0 dB).",
        "worse: resolves a line pair of 4.00 mm on the object, published 3.20 mm: coarser.",
        "equal: resolves a line pair of 2.00 mm on the object, published 2.02 mm: the same within "
        "3 %.",
        "From finest to coarsest on the chart: better (1.00 mm), equal (2.00 mm), worse (4.00 mm).",
    ]
