"""Points of a sweep: configuration, key, measurement, and their summary."""

import json
from dataclasses import asdict

import jax
import numpy as np
import pyarrow as pa
import pytest
import skimage.io
from commands.study import tiny
from commands.sweep import mini

from helpers import compilations
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import StudyConfig
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.sweep import point as point_module
from thincam_jax.commands.sweep.point import described, measure_point
from thincam_jax.commands.sweep.run import summarise


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return mini.study(tmp_path_factory.mktemp("mini"))


def keys(points):
    return [point.key for point in points]


def fault(config, *grid):
    with pytest.raises(ConfigError) as caught:
        mini.points(config, *grid)
    (line,) = str(caught.value).splitlines()
    return line


def test_configuration_of_a_point_is_that_of_set(config, tmp_path):
    """The same as with --set, whole; the values are in the package's units."""
    grid = ("methods.0.shots.0.beta=20:25:2 rad/mm^2", "wavelength=0.6 um", "seed=3,4")
    points = mini.points(config, *grid)
    assert [tuple(p.values.values()) for p in points] == [
        (20.0, 0.0006, 3),
        (20.0, 0.0006, 4),
        (25.0, 0.0006, 3),
        (25.0, 0.0006, 4),
    ]
    overrides = ("methods.0.shots.0.beta=20 rad/mm^2", "wavelength=600 nm", "seed=4")
    assert StudyConfig.model_validate_json(points[1].config) == mini.study(tmp_path, *overrides)


def test_linked_entries_are_set_together(tmp_path):
    config = tiny.study(tmp_path)
    (point,) = mini.points(config, "methods.*.shots.*.distance=4 mm")
    methods = StudyConfig.model_validate_json(point.config).methods
    assert [shot.distance for m in methods for shot in m.shots] == [4.0, 4.0, 4.0]
    assert point.values == {"methods.*.shots.*.distance": 4.0}


def test_entries_that_are_no_numbers(config):
    grid = ("sensor.shape=[32, 48]", "noise={snr_db: 20}", "sensor.bit_depth=null")
    (point,) = mini.points(config, *grid)
    shape, noise, depth = point.values.values()
    assert json.loads(shape) == [32, 48]
    assert json.loads(noise) == {"snr_db": 20.0, "signal_power": "total"}
    assert depth is None


class TestKey:
    def test_is_that_of_the_configuration_not_of_the_grid(self, config):
        all_ = mini.points(config, "seed=0:4:5")
        assert len(set(keys(all_))) == 5
        assert keys(mini.points(config, "seed=3,1")) == [all_[3].key, all_[1].key]
        assert keys(mini.points(config, "seed=2", "noise.snr_db=30")) == [all_[2].key]
        assert keys(mini.points(config, "mask.width=2000 um")) == [all_[0].key]

    def test_depends_on_precision_and_version(self, config, monkeypatch):
        single, double = (mini.points(config, "seed=1", double=d)[0] for d in (False, True))
        assert single.key != double.key
        assert not single.double and double.double
        monkeypatch.setattr(point_module, "METRICS_VERSION", 10**6)
        assert mini.points(config, "seed=1")[0].key != single.key

    def test_depends_on_the_pixels_of_a_picture(self, tmp_path):
        config = tiny.study(tmp_path)
        before = keys(mini.points(config, "seed=1"))
        skimage.io.imsave(tmp_path / "picture.png", np.eye(48, dtype=np.uint8) * 255)
        assert keys(mini.points(config, "seed=1")) != before


def test_refused_point_has_its_reason(config):
    good, bad = mini.points(config, "methods.0.shots.0.beta=25,-5 rad/mm^2")
    assert good.reason is None
    assert bad.config is None
    assert bad.values == {"methods.0.shots.0.beta": "-5 rad/mm^2"}
    assert bad.reason == (
        "--grid methods.0.shots.0.beta=25,-5 rad/mm^2: methods[0].shots[0].beta: "
        '"-5 rad/mm^2" is not positive; give a value above zero'
    )
    assert described(bad.values) == "methods.0.shots.0.beta=-5 rad/mm^2"


def test_point_that_comes_twice(config):
    line = fault(config, "mask.width=2 mm, 1 mm, 2000 um")
    assert line == (
        "--grid: mask.width=2.0 comes twice: two of its values are the same; give each once"
    )


@pytest.mark.thorough
def test_columns_are_the_metrics_of_a_run(tmp_path):
    targets = tiny.TEXT[tiny.TEXT.index("  - {name: chart") :]
    config = tiny.study(tmp_path, text=mini.TEXT[: mini.TEXT.index("  - {name: star")] + targets)
    (point,) = mini.points(config, "seed=0", double=True)
    measured = measure_point(point.config, point.double)
    assert measured.reason is None
    row = measured.metrics
    assert row is not None
    assert row.pop("seconds") > 0
    expected, study = {}, build_study(config)
    methods = asdict(study.run().scores)["methods"]
    for name, method in methods.items():
        mean = sum(target["psnr_db"] for target in method["targets"].values()) / 2
        expected[f"mean_psnr_db/{name}"] = pytest.approx(mean, abs=1e-4)
        key = "mean_psnr_of_pictures_db"
        expected[f"{key}/{name}"] = method[key]
        for target, metrics in method["targets"].items():
            resolved = metrics.pop("resolved")
            if resolved:
                metrics |= {f"resolved_{inner}": value for inner, value in resolved.items()}
            expected |= {f"{key}/{name}/{target}": value for key, value in metrics.items()}
    assert row == expected
    assert any(name.startswith("mean_psnr_of_pictures_db/") for name in row)


@pytest.mark.thorough
def test_values_of_one_shape_are_compiled_once(tmp_path):
    config, rows = mini.study(tmp_path), []
    (first,) = mini.points(config, "seed=0")
    beta = mini.points(config, "methods.0.shots.0.beta=15:24:4 rad/mm^2")
    noise = mini.points(config, "noise.snr_db=20:28:3")
    distance = mini.points(config, "methods.0.shots.0.distance=2.99:2.995:2 mm")
    jax.clear_caches()

    def measure(*points):
        rows.extend(measure_point(p.config, False).metrics for p in points)

    assert compilations(lambda: measure(first)) > 0
    assert compilations(lambda: measure(*beta, *noise, *distance)) == 0
    psnr = [row["psnr_db/single/star"] for row in rows if row is not None][1:]
    assert len(set(psnr)) == 9  # they are other points


def test_camera_that_cannot_be_built_is_a_reason(tmp_path):
    (point,) = mini.points(mini.study(tmp_path), "mask.pixel_pitch=0.7 mm")
    measured = measure_point(point.config, False)
    assert measured.metrics is None
    assert measured.reason is not None
    assert measured.reason.startswith("mask, sensor or model: width = 2 mm is not a whole number")
    assert measured.traceback is None


def test_defect_is_a_reason_with_its_traceback(tmp_path, monkeypatch):
    def broken(_):
        raise ZeroDivisionError("a\n  defect")

    monkeypatch.setattr("thincam_jax.commands.sweep.point.build_study", broken)
    (point,) = mini.points(mini.study(tmp_path), "seed=1")
    measured = measure_point(point.config, False)
    assert measured.reason == "ZeroDivisionError: a"
    assert "in broken" in (measured.traceback or "")


AXES = ["methods.0.shots.0.beta", "model"]
COLUMN = "mean_psnr_db/single"


def rows():
    """Six points, of which one has no PSNR; best at β = 20 with the second model."""
    level = {(15.0, "a"): 20.0, (20.0, "a"): 22.0, (25.0, "a"): None}
    level |= {(15.0, "b"): 21.0, (20.0, "b"): 24.0, (25.0, "b"): 23.0}
    return [dict(zip(AXES, at, strict=True), **{COLUMN: psnr}) for at, psnr in level.items()]


def test_best_point_and_picture(tmp_path):
    best = summarise(tmp_path, pa.Table.from_pylist(rows()), AXES)
    place = "methods.0.shots.0.beta=20.0, model=b"
    assert best == (f"best mean PSNR of single: 24.00 dB at {place}",)
    assert skimage.io.imread(tmp_path / "summary.png").std() > 5


@pytest.mark.parametrize("table", [{"seed": [1]}, {"seed": [1], COLUMN: [None]}])
def test_nothing_to_tell(tmp_path, table):
    assert summarise(tmp_path, pa.table(table), ["seed"]) == ()
    assert list(tmp_path.iterdir()) == []
