"""Scores of a method: a perfect reconstruction, a mirrored one, and what the chart resolves."""

import jax.numpy as jnp
import numpy as np
import pytest
from studies import tiny

from thincam_jax._core.grids import Grid
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import evaluate

CHART, PICTURE = 0, 1


@pytest.fixture(scope="module")
def study():
    return tiny.study()


def scored(study, number, change, pitch=1.0):
    """The evaluation of the scene itself on pixels of `pitch`, after a change."""
    target = study.targets[number]
    plane = target.plane
    rows, columns = (round(float(n) / pitch) for n in (plane.height, plane.width))
    grid = Grid((rows, columns), pitch)
    image = np.asarray(plane.sample(grid, magnification=1.0), dtype=float)
    result = Reconstruction(jnp.asarray(change(image)), jnp.asarray(pitch))
    return evaluate(study.methods[0], target, result)


@pytest.mark.parametrize("target", [CHART, PICTURE])
def test_perfect_but_for_gain_and_offset(study, target):
    found = scored(study, target, lambda image: 7.0 * image - 3.0)
    assert found.scores.psnr_db is None  # infinite, which JSON does not have
    assert found.scores.ssim > 0.9999
    assert found.image == pytest.approx(found.truth, abs=1e-5)  # in the scene's own units


def test_small_error(study):
    """An error of ±0.001, uncorrelated with the scene: 60 dB."""
    signs = np.random.default_rng(0).choice([-1e-3, 1e-3], (4000, 4000))
    found = scored(study, PICTURE, lambda i: i + signs[: i.shape[-2], : i.shape[-1]], pitch=0.5)
    assert found.scores.psnr_db == pytest.approx(60, abs=0.05)


@pytest.mark.parametrize("axis", [-1, -2])
def test_mirrored(study, axis):
    found = scored(study, PICTURE, lambda image: np.flip(image, axis))
    assert found.scores.psnr_db < 25
    assert found.scores.ssim < 0.9


def test_channels_keep_their_place(study):
    found = scored(study, PICTURE, lambda image: image[::-1])
    assert found.truth.shape == (60, 80, 3)
    assert found.scores.psnr_db < 25


def test_known_error(study):
    """±0.1 in a checkerboard on a channel of variance V: the best gain leaves 0.01·V/(V + 0.01)."""

    def checkered(image):
        y, x = np.indices(image.shape[-2:])
        return image + 0.1 * (-1.0) ** (x + y)

    found = scored(study, PICTURE, checkered)
    variance = found.truth.var(axis=(0, 1))
    expected = -10 * np.log10(np.mean(0.01 * variance / (variance + 0.01)))
    assert found.scores.psnr_db == pytest.approx(expected, abs=0.02)


def test_resolved_element_of_the_perfect_chart(study):
    """All that the pixels hold: a bar of 2.5 mm is 2.5 pixels; 80/6.67 … the coarsest is 5 mm."""
    found = scored(study, CHART, lambda image: image, pitch=0.5)
    resolved = found.scores.resolved
    assert resolved.object_mm <= 2.5
    # Seen from the mask, d/t times smaller on the sensor.
    assert resolved.sensor_cycles_per_mm == pytest.approx(100 / 3 / resolved.object_mm, rel=1e-3)
    assert {direction for _, direction, _ in found.contrast} == {"vertical", "horizontal"}
    coarsest = [contrast for period, _, contrast in found.contrast if period == 5.0]
    assert coarsest == pytest.approx([1.0, 1.0], abs=0.05)


def test_nothing_resolved_in_a_blurred_chart(study):
    def blurred(image):
        return image * 0.0 + np.linspace(0, 1, image.shape[-1])

    assert scored(study, CHART, blurred, pitch=0.5).scores.resolved is None


def test_a_picture_has_no_resolution(study):
    found = scored(study, PICTURE, lambda image: image)
    assert found.scores.resolved is None
    assert found.contrast is None
