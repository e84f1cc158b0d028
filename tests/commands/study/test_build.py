"""From a study's file to exposures and cameras."""

from dataclasses import replace

import numpy as np
import pytest
from commands.study import tiny

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.studies.evaluate import expose, noise_free, reconstructor, stacked, take

ELECTRONS = ("sensor.electrons=2e5", "noise={read_noise: 2}")


def pairs(folder, shot, *overrides):
    """The tiny study with another second shot of its pairs; and these."""
    study = tiny.built(folder, *ELECTRONS, *overrides, f"methods.1.shots.1={shot}")
    return study, study.methods[1]


def test_a_shot_may_have_its_own_mask_and_exposure(tmp_path):
    shot = "{beta: 25 rad/mm^2, distance: 3 mm, width: 1.2 mm, exposure: 0.5}"
    study, method = pairs(tmp_path, shot)
    assert [(e.width, e.relative_time) for e in method.exposures] == [(2.0, 1.0)] * 2 + [
        (1.2, 0.5)
    ] * 2
    camera = study.camera(method.exposures[2])
    assert float(camera.mask.width) == pytest.approx(1.2)
    assert float(camera.sensor.electrons) == pytest.approx(1e5)
    study, method = pairs(
        tmp_path,
        "{beta: 21 /mm^2, distance: 3 mm, exposure: 0.5}",
        "sensor={shape: [48, 64], pitch: 40 um, exposure: 0.8}",
    )
    assert float(study.camera(method.exposures[2]).sensor.exposure) == pytest.approx(0.4)


def test_a_mask_may_be_a_rectangle(tmp_path):
    """Of which a shot may change the width; zones are as fine as at its farther edges."""
    shot = "{beta: 25 rad/mm^2, distance: 3 mm, width: 1.2 mm}"
    study, method = pairs(tmp_path, shot, "mask={width: 2 mm, height: 3.5 mm}")
    assert study.camera(method.exposures[2]).mask.extent == pytest.approx((3.5, 1.2))
    told, _ = study.warnings  # the other is of the field
    assert told.startswith("the mask casts 13.5 cycles/mm on pixels that resolve 12.5")


def test_a_second_take_has_noise_of_its_own(tmp_path):
    """Of one camera, which sees the same without noise."""
    again = "{beta: 25 /mm^2, distance: 3 mm, take: 2}"
    study = tiny.built(tmp_path, f"methods.1.shots.1={again}")
    method = study.methods[1]
    first, second = method.exposures[0], method.exposures[2]
    assert second == replace(first, take=2)
    plane = study.targets[0].plane
    clean = noise_free(study, first, plane)
    np.testing.assert_array_equal(clean, noise_free(study, second, plane))
    one, other = (expose(study, e, clean, 0) for e in (first, second))
    assert np.all(one.variance == other.variance)
    assert np.std(one.image - other.image) == pytest.approx(np.sqrt(2 * one.variance[0]), rel=0.1)
    with pytest.raises(ConfigError, match="shots hold an entry twice"):
        pairs(tmp_path, again, "methods.1.synthesis=contrasts")
    with pytest.raises(ConfigError, match="greater than or equal to 2"):
        pairs(tmp_path, again.replace("take: 2", "take: 1"))


def test_contrasts_are_of_masks_of_one_width(tmp_path):
    shot = "{beta: 21 /mm^2, distance: 3 mm, width: 1 mm}"
    with pytest.raises(ConfigError, match="methods.1..shots: synthesis contrasts needs masks of"):
        pairs(tmp_path, shot, "methods.1.synthesis=contrasts")


def test_less_light_has_more_noise(tmp_path):
    """A narrower mask and a shorter exposure: shot noise is the light over the electrons."""
    shot = "{beta: 25 /mm^2, distance: 3 mm, width: 1 mm, exposure: 0.25}"
    study, method = pairs(tmp_path, shot)
    variances, light = [], []
    for exposure in (method.exposures[0], method.exposures[2]):
        clean = noise_free(study, exposure, study.targets[1].plane)
        light.append(np.asarray(clean).mean(axis=(-2, -1)))
        variances.append(expose(study, exposure, clean, 1).variance)
    assert np.all(light[1] < 0.8 * light[0])
    for share, mean, variance in zip((1.0, 0.25), light, variances, strict=True):
        counted = 2e5 * share
        np.testing.assert_allclose(variance, mean / counted + (2 / counted) ** 2, rtol=1e-5)


def test_a_moving_target_goes_on_from_capture_to_capture(tmp_path):
    """Half way through a method's captures it is on the axis; what each sees is the mean."""
    shot = "{beta: 21 rad/mm^2, distance: 3 mm, exposure: 0.5}"
    study, method = pairs(tmp_path, shot, "object.motion=4 mm")
    assert [e.moves for e in method.exposures] == [(-6, -2), (-2, 2), (2, 4), (4, 6)]
    exposure, target = method.exposures[0], study.targets[0]
    image, far, wide = target.plane.image, target.distance, target.width
    at = [ImagePlane(image, far, wide, moves) for moves in (None, (4, 4), (-2, 2))]
    still, beside, moving = (noise_free(study, exposure, plane) for plane in at)
    # 4 mm on the object are 3 pixels on the sensor, the other way.
    np.testing.assert_allclose(beside[..., :-3], still[..., 3:], rtol=1e-6)
    np.testing.assert_allclose(moving.sum(), still.sum(), rtol=1e-3)


def test_two_phases_in_quadrature_are_fringe_scanned(tmp_path):
    """Points come out as by four phases, but for the background that is left between them."""
    images, phases = [], []
    points = "targets.0={name: points, kind: point_grid, pixels: 120}"
    for synthesis in ("fringe_scanning", "phase_pairs"):
        study = tiny.built(tmp_path, points, f"methods.0.synthesis={synthesis}")
        method, target = study.methods[0], study.targets[0]
        captures = stacked([take(study, exposure, target) for exposure in method.exposures])
        found = reconstructor(study, method, (30, 40), target.distance)(*captures)
        images.append(np.ravel(found.image))
        phases.append([exposure.phase / np.pi for exposure in method.exposures])
    assert phases == [[0, 0.5, 1, 1.5], [0, 1.5]]
    assert np.corrcoef(*images)[0, 1] > 0.5
