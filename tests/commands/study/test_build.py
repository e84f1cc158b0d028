"""From a study's file to settings and cameras."""

import numpy as np
import pytest
from commands.study import tiny

from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import ConfigError, load_config

ELECTRONS = ("sensor.electrons=2e5", "noise={read_noise: 2}")


def study(folder, shot, *overrides):
    """The tiny study with another second shot of its pairs."""
    changed = (*ELECTRONS, *overrides, f"methods.1.shots.1={shot}")
    return load_config(tiny.write(folder), changed)


def test_a_shot_may_have_its_own_mask_and_exposure(tmp_path):
    config = study(tmp_path, "{beta: 25 /mm^2, distance: 3 mm, width: 1.2 mm, exposure: 0.5}")
    used = build.settings(config, config.methods[1])
    assert [(s.width, s.exposure) for s in used] == [(2.0, 1.0)] * 2 + [(1.2, 0.5)] * 2
    camera = build.build_camera(config, used[2])
    assert float(camera.mask.width) == pytest.approx(1.2)
    assert float(camera.sensor.electrons) == pytest.approx(1e5)
    relative = study(
        tmp_path,
        "{beta: 21 /mm^2, distance: 3 mm, exposure: 0.5}",
        "sensor={shape: [48, 64], pitch: 40 um, exposure: 0.8}",
    )
    camera = build.build_camera(relative, build.settings(relative, relative.methods[1])[2])
    assert float(camera.sensor.exposure) == pytest.approx(0.4)


def test_the_same_shot_twice_and_longer(tmp_path):
    """Another exposure is another capture; the same one would count its noise twice."""
    config = study(tmp_path, "{beta: 25 /mm^2, distance: 3 mm, exposure: 0.5}")
    assert len(set(build.settings(config, config.methods[1]))) == 4
    with pytest.raises(ConfigError, match="shots hold an entry twice"):
        study(tmp_path, "{beta: 25 /mm^2, distance: 3 mm, width: 2000 um}")
    longer = "{beta: 25 /mm^2, distance: 3 mm, exposure: 0.5}"
    with pytest.raises(ConfigError, match="shots hold an entry twice"):
        study(tmp_path, longer, "methods.1.synthesis=contrasts")


def test_contrasts_are_of_masks_of_one_width(tmp_path):
    shot = "{beta: 21 /mm^2, distance: 3 mm, width: 1 mm}"
    with pytest.raises(ConfigError, match="methods.1..shots: synthesis contrasts needs masks of"):
        study(tmp_path, shot, "methods.1.synthesis=contrasts")


def test_less_light_has_more_noise(tmp_path):
    """A narrower mask and a shorter exposure: shot noise is the light over the electrons."""
    config = study(tmp_path, "{beta: 25 /mm^2, distance: 3 mm, width: 1 mm, exposure: 0.25}")
    plane = build.build_plane(config, config.targets[1])
    wide, narrow = (build.settings(config, config.methods[1])[n] for n in (0, 2))
    variances, light = [], []
    for setting in (wide, narrow):
        camera = build.build_camera(config, setting)
        clean = build.imaging(config, camera, setting, plane)
        light.append(np.asarray(clean).mean(axis=(-2, -1)))
        key = build.capture_key(config, 1, 0)
        variances.append(build.expose(config, camera, clean, key).variance)
    assert np.all(light[1] < 0.8 * light[0])
    for share, mean, variance in zip((1.0, 0.25), light, variances, strict=True):
        counted = 2e5 * share
        np.testing.assert_allclose(variance, mean / counted + (2 / counted) ** 2, rtol=1e-5)
