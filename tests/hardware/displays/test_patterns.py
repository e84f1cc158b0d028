"""Patterns against the masks and the Hadamard series that they show."""

import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick
from thincam_jax.hardware.acquisition.plan import BLACK, Pattern
from thincam_jax.hardware.displays.patterns import mask_pattern, on_cells, pattern_levels
from thincam_jax.hardware.plans import zone_plate
from thincam_jax.measured.calibration.hadamard import HadamardSeries

PITCH = 0.036  # mm, the modulator of the thesis
SHAPE = 24, 40


def zones(profile, phase=0.4, pixels=(16, 32)):
    rows, columns = pixels
    return tc.FresnelZoneAperture(
        beta=12.0,
        phase=phase,
        width=columns * PITCH,
        height=rows * PITCH,
        profile=profile,
        pixel_pitch=PITCH,
        fill_factor=0.6,
    )


@pytest.mark.parametrize("profile", quick(["cosine", "intensity", "binary"], 0))
def test_zones_are_those_of_the_formula(profile):
    y, x = (PITCH * (np.arange(count) - (count - 1) / 2) for count in SHAPE)
    wave = np.cos(12.0 * (y[:, None] ** 2 + x**2) + 0.4)
    irradiance = {
        "cosine": ((1 + wave) / 2) ** 2,  # of the amplitude (1 + cos)/2
        "intensity": (1 + wave) / 2,
        "binary": (wave > 0).astype(float),
    }[profile]
    outside = np.ones(SHAPE, bool)
    outside[4:20, 4:36] = False
    irradiance[outside] = 0
    pattern = mask_pattern(zones(profile), SHAPE, PITCH)
    assert pattern.dtype == np.uint8 and pattern.shape == SHAPE
    assert np.abs(pattern - 255 * irradiance).max() < 1.0  # levels
    if profile == "binary":
        assert set(np.unique(pattern)) == {0, 255}


def test_cells_are_squares_of_pixels():
    mask = tc.SeparableMask([1, 0, 1], [0, 1, 1, 0.5], 4 * PITCH)
    expected = np.zeros(SHAPE)
    cells = np.outer([1, 0, 1], [0, 1, 1, 0.25])
    expected[6:18, 12:28] = np.kron(255 * cells, np.ones((4, 4)))
    np.testing.assert_array_equal(mask_pattern(mask, SHAPE, PITCH), np.rint(expected))


@pytest.mark.parametrize(
    ("mask", "pitch", "message"),
    [
        (tc.SeparableMask([1, 0], [1, 1], 1.4 * PITCH), PITCH, "mask for pixels of 0.0504 mm"),
        (zones("binary"), 0.03, "the display's have 0.03 mm"),
        (zones("binary", pixels=(26, 32)), PITCH, "26 × 32 pixels; the display has 24 × 40"),
        (zones("binary", pixels=(15, 32)), PITCH, "even or odd"),
    ],
)
def test_masks_that_do_not_fit(mask, pitch, message):
    with pytest.raises(ValueError, match=message):
        mask_pattern(mask, SHAPE, pitch)


def test_levels_of_the_patterns_of_a_plan():
    plate = zone_plate(12.0, 16 * PITCH, phase=0.4)
    mask = tc.FresnelZoneAperture(12.0, 0.4, width=16 * PITCH, pixel_pitch=PITCH)
    assert np.array_equal(pattern_levels(plate, SHAPE, PITCH), mask_pattern(mask, SHAPE, PITCH))
    numbers = {"rows": 4, "columns": 8, "order": "natural", "display": "complementary", "frame": 5}
    series = HadamardSeries((4, 8), order="natural", display="complementary")
    frame = pattern_levels(Pattern("hadamard", numbers), SHAPE, PITCH)
    assert np.array_equal(frame, on_cells(255 * series.frame(5), SHAPE))
    assert not pattern_levels(BLACK, SHAPE, PITCH).any()
    with pytest.raises(ValueError, match="kind 'own' has no levels"):
        pattern_levels(Pattern("own"), SHAPE, PITCH)


@pytest.mark.parametrize("shape", [(40, 60), (41, 61)])
def test_a_mark_is_a_disc_about_the_pixel_nearest_to_its_place(shape):
    """Its mean place is exact, whatever a display makes of levels between black and white."""
    mark = Pattern("mark", {"x": 4.2, "y": -3.1, "size": 3.0})
    levels = pattern_levels(mark, shape, 0.5)
    assert set(np.unique(levels)) == {0, 255}
    row, column = np.argwhere(levels).mean(axis=0)
    assert row == round((shape[0] - 1) / 2 - 6.2) and column == round((shape[1] - 1) / 2 + 8.4)
    assert abs(np.count_nonzero(levels) / (np.pi * 9) - 1) < 0.2
    with pytest.raises(ValueError, match="a mark of 3 mm at 14.5, 0 mm is not all on the display"):
        pattern_levels(Pattern("mark", {"x": 14.5, "y": 0.0, "size": 3.0}), shape, 0.5)
