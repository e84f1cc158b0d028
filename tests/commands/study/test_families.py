"""Masks of other families than the zone plate in a study's file."""

import jax
import numpy as np
import pytest
from commands.study import tiny
from PIL import Image

import thincam_jax as tc
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.study.build import build_study
from thincam_jax.lensless.masks import MaskBlank, maximum_length_sequence
from thincam_jax.lensless.masks.display import on_display
from thincam_jax.lensless.masks.phase import voronoi_fresnel

HEAD, TAIL = tiny.TEXT.split("methods:")[0], "targets:" + tiny.TEXT.split("targets:")[1]
METHOD = "{name: one, kind: wiener, synthesis: separate, shots: [{distance: 3 mm}]}"
MURA = "{family: mura, order: 13, cell: 120 um}"


def written(folder, mask=MURA, method=METHOD):
    text = HEAD.replace("{width: 2 mm}", mask) + f"methods:\n  - {method}\n" + TAIL
    return tiny.write(folder, text)


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        (MURA, tc.ModifiedUniformlyRedundantArray(13, 0.12)),
        ("{family: ura, orders: [7, 5], cell: 120 um, tiles: 2}", "ura"),
        (
            "{family: mls, length: 15, cell: 0.1 mm, combine: product}",
            tc.SeparableMask(*2 * [maximum_length_sequence(15)], 0.1),
        ),
        ("{family: random, width: 1.2 mm, cell: 0.1 mm, seed: 3}", "random"),
        ("{family: pinhole, width: 0.2 mm}", tc.Pinhole(0.2)),
        (
            MURA[:-1] + ", pixel_pitch: 40 um, fill_factor: 0.6}",
            on_display(tc.ModifiedUniformlyRedundantArray(13, 0.12), 0.04, 0.6),
        ),
    ],
)
def test_family(tmp_path, mask, expected):
    path = written(tmp_path, mask)
    config = load_experiment(path)
    built = build_study(config)
    (exposure,) = built.exposures
    camera = built.camera(exposure)
    if not isinstance(expected, str):
        same = tc.LenslessCamera(expected, camera.sensor, 3.0)
        h = tc.psf(
            same,
            wavelength=500e-6,
            object_distance=100.0,
            model="geometric",
            pixel_integration=False,
        )
        np.testing.assert_allclose(built.psf(exposure), h, rtol=1e-6, atol=1e-7)
    assert config.mask.label in built.mask_of(exposure)
    path.write_text(dump_config(config))  # a resolved file is read back
    assert load_experiment(path) == config


def test_phase_masks(tmp_path):
    """Heights are made once, of as many cells as the width holds."""
    numbers = "width: 0.6 mm, cell: 20 um, index: 1.5, seed: 2"
    masks = []
    for own in (
        "family: diffuser, correlation_length: 80 um, rms_slope: 0.008",
        "family: voronoi_fresnel, sites: 5, focal_length: 20 mm",
    ):
        config = load_experiment(
            written(tmp_path, f"{{{own}, {numbers}}}"), ("model=angular_spectrum",)
        )
        study = build_study(config)
        masks.append(study.camera(study.exposures[0]).mask)
    blank, key = MaskBlank((30, 30), 0.02, 1.5), jax.random.key(2)
    expected = voronoi_fresnel(key, blank, sites=5, focal_length=20.0, wavelength=500e-6)
    np.testing.assert_allclose(masks[1].height, expected.height)
    assert [mask.interpolation for mask in masks] == ["bilinear", "cells"]
    assert masks[0].height.shape == (30, 30) and float(masks[0].material(5e-4)) == 1.5


def test_an_image_file_is_a_mask(tmp_path):
    path = written(tmp_path, f"{{family: file, path: {tmp_path / 'picture.png'}, width: 2 mm}}")
    with pytest.raises(ConfigError, match="mask, sensor or model: .*picture.png' is coloured") as e:
        build_study(load_experiment(path))
    assert "\n" not in str(e.value)


def test_an_image_file_is_read_once(tmp_path, monkeypatch):
    """However many exposures there are, and for its warnings."""
    picture = Image.fromarray(np.uint8(255 * np.eye(12)))
    picture.save(tmp_path / "picture.png")
    read, read_mask = [], tc.read_mask
    monkeypatch.setattr(
        "thincam_jax.commands.mask.read_mask", lambda *a: read.append(a) or read_mask(*a)
    )
    shots = METHOD.replace("{distance: 3 mm}", "{distance: 3 mm}, {distance: 4 mm}")
    mask = f"{{family: file, path: {tmp_path / 'picture.png'}, width: 2 mm}}"
    built = build_study(load_experiment(written(tmp_path, mask, shots)))
    assert built.warnings is not None and len(built.exposures) == 2
    assert [built.camera(exposure).distance for exposure in built.exposures] == [3, 4]
    assert len(read) == 1


@pytest.mark.parametrize(
    ("mask", "method", "message"),
    [
        ("{family: mura, order: 100, cell: 30 um}", METHOD, "mask.order: .* give 97 or 101"),
        ("{family: mura, order: 101, cell: 30 mm}", METHOD, "mask.cell: makes a mask of 3030 mm"),
        ("{width: 2 mm, harmonics: 4}", METHOD, "mask.harmonics: .* give an odd number from 1"),
        ("{family: pinhole, width: 1 mm, order: 5}", METHOD, "mask.order: is no number of a mask"),
        (MURA, METHOD.replace("separate", "phase_pairs"), "synthesis: a mask of the family mura"),
        (MURA, METHOD.replace("3 mm", "3 mm, beta: 5 rad/mm^2"), "beta: is of a zone plate"),
    ],
)
def test_refused_in_one_line(tmp_path, mask, method, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_experiment(written(tmp_path, mask, method))
    assert "\n" not in str(error.value)
