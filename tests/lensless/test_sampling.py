"""Where pixels are coarser than what the mask casts on them, it is said, once and with numbers."""

import warnings

import jax
import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick
from thincam_jax.lensless.resolve import SamplingWarning
from thincam_jax.units import um

SCENE = tc.Scene(tc.ImagePlane(np.ones((3, 4)), distance=250.0, width=60.0), 5e-4)


def camera(mask, pitch):
    return tc.LenslessCamera(mask, tc.Sensor((12, 16), pitch), distance=6.5)


FZA = tc.FresnelZoneAperture(25.0, width=5.632)


@pytest.mark.parametrize(("pitch", "quiet"), quick([(88 * um, False), (22 * um, True)], 0))
def test_zones_finer_than_the_pixels_are_told_in_one_line(pitch, quiet):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tc.capture(camera(FZA, pitch), SCENE, model="geometric")
    if quiet:
        assert not caught
        return
    (told,) = caught
    assert told.category is SamplingWarning
    # βR/π = 22.4 on the mask, at M = 1 + 6.5/250 = 1.026 on the sensor.
    assert str(told.message) == (
        "the mask casts 21.8 cycles/mm on pixels that resolve 5.68 (Nyquist, 1/(2 pitch)): "
        "what is finer is averaged away or aliased; give a pitch of at most 22.8 um, or a mask of "
        "coarser zones or cells"
    )


def test_nothing_is_said_of_numbers_that_are_not_known():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(
            lambda beta: tc.capture(
                camera(tc.FresnelZoneAperture(beta, width=5.632), 88 * um), SCENE, model="geometric"
            ),
            25.0,
        )


def test_cells_count_by_the_pattern_that_they_hold():
    """Random cells of p hold frequencies up to 1/(2p) evenly; finer cells of the same add edges."""
    random = np.random.default_rng(0).integers(0, 2, (60, 80)).astype(float)
    known = tc.SampledMask(random, 10 * um).finest_frequency
    assert known == pytest.approx(50 / np.sqrt(2), rel=0.03)  # half of the square's area
    same = tc.SampledMask(np.kron(random, np.ones((4, 4))), 2.5 * um).finest_frequency
    assert known < same < 1.3 * known
    assert tc.SampledMask(np.ones((3, 4)), 10 * um).finest_frequency == 0
    wave = 0.5 + 0.4 * np.cos(2 * np.pi * np.arange(80) / 20) * np.ones((60, 1))
    assert tc.SampledMask(wave, 10 * um).finest_frequency == pytest.approx(5.0)  # of |t|²: and 10
