"""Exposures that are taken at once by masks side by side: their cameras, motion, file, refusals."""

import numpy as np
import pytest
from commands.study import tiny as file
from studies import tiny

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.lensless.exposures import Layout
from thincam_jax.studies import Method
from thincam_jax.studies.evaluate import evaluate_method, take
from thincam_jax.units import nm, um

LIGHT = {"wavelength": 500 * nm, "width": 0.9}
FOUR = Layout(2, 2, wall=0.05)


def exposures(layout=FOUR, **others):
    return tc.Exposures(50.0, 3.0, **LIGHT, **others).fringe_scanned().at_once(layout)


@pytest.mark.thorough
def test_captures_are_parts_of_a_frame():
    method = Method("mosaic", exposures(), tc.Wiener(), "fringe_scanning")
    study = tiny.study(methods=(method,), noise=None)
    target = study.targets[1]
    captures = [take(study, exposure, target).image for exposure in method.exposures]
    masks = [one.mask() for one in tc.Exposures(50.0, 3.0, **LIGHT).fringe_scanned()]
    mosaic = tc.Mosaic([masks[:2], masks[2:]], study.sensor, 3.0, wall=0.05)
    seen = tc.Scene(tc.ImagePlane(target.plane.image, 100.0, 80.0), 500 * nm)
    frame = tc.capture(mosaic, seen, model="geometric", pixel_integration=False)
    for part, image in zip(mosaic.split(frame), captures, strict=True):
        assert relative_l2(image, part) < 1e-5
    found = evaluate_method(
        study, method, target, {e: take(study, e, target) for e in method.exposures}
    )
    assert found.scores.psnr_db is not None and found.scores.psnr_db > 12


def test_shots_at_several_distances_are_spacers():
    pairs = tc.Exposures([50.0, 40.0], [3.0, 3.4], **LIGHT).phase_pairs().at_once(FOUR)
    cameras = pairs.cameras(tc.Sensor((48, 64), 40 * um))
    assert [float(camera.distance) for camera in cameras] == pytest.approx([3.0, 3.0, 3.4, 3.4])
    assert cameras[0].sensor.shape == (22, 30)


def test_all_parts_see_the_whole_way():
    moves = exposures(relative_time=4.0).of_moving(0.5).moves
    np.testing.assert_allclose(moves, [[-1.0, 1.0]] * 4)


MOSAIC = "    mosaic: {rows: 2, columns: 2, wall: 0.05 mm}\n    shots:\n"


def with_mosaic(line=MOSAIC):
    head, first, rest = file.TEXT.partition("    kind: fringe_scanning\n    shots:\n")
    assert first
    rest = rest.replace("distance: 3 mm}", "distance: 3 mm, width: 0.9 mm}", 1)
    return head + "    kind: fringe_scanning\n" + line + rest


def test_a_file_has_one(tmp_path):
    study = file.built(tmp_path, text=with_mosaic())
    method = study.methods[0]
    assert method.exposures.layout == FOUR
    cameras = [study.camera(exposure) for exposure in method.exposures]
    assert {camera.sensor.shape for camera in cameras} == {(22, 30)}
    places = np.array([camera.place for camera in cameras])
    np.testing.assert_allclose(places, [[y, x] for y in (-0.48, 0.48) for x in (-0.64, 0.64)])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (MOSAIC.replace("columns: 2", "columns: 3"), "4 exposures do not fill 2×3 masks"),
        (MOSAIC.replace(", wall: 0.05 mm", ""), "give the mosaic a wall, or use kind wiener"),
        (MOSAIC.replace("0.05 mm", "0.2 mm"), "give smaller masks, a larger pitch or a thinner"),
    ],
)
def test_faults_of_a_file(line, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        file.built(tmp_path, text=with_mosaic(line))
