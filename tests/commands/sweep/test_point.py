"""Points: their configurations, their keys, and which are refused."""

import json

import numpy as np
import pytest
import skimage.io
from commands.study import tiny
from commands.sweep import mini

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import StudyConfig
from thincam_jax.commands.sweep import point as point_module
from thincam_jax.commands.sweep.point import described


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


@pytest.mark.parametrize(
    ("grid", "part"),
    [
        ("sed=1,2", "sed: unknown key; allowed here: name, title, seed"),
        ("mask.radius=1 mm", "mask.radius: unknown key; allowed here: width"),
        ("mask.width=1,2", "mask.width: 1 has no unit"),
        ("mask.width=1:2:3 nms", 'has the unknown unit "nms"'),
        ("methods.3.name=a", "methods has no entry 3"),
        ("seed=0.5,1.5", "seed: 0.5: input should be a valid integer"),
    ],
)
def test_grid_without_a_point_that_can_be_run(config, grid, part):
    line = fault(config, grid)
    assert line.startswith(f"--grid {grid}: ")
    assert part in line


def test_point_that_comes_twice(config):
    line = fault(config, "mask.width=2 mm, 1 mm, 2000 um")
    assert line == (
        "--grid: mask.width=2.0 comes twice: two of its values are the same; give each once"
    )
