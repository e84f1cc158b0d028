"""Hadamard patterns against their definition, and the transform against SciPy's matrix."""

import numpy as np
import pytest
import scipy

from thincam_jax.measured.calibration import HadamardSeries
from thincam_jax.measured.calibration.hadamard import hadamard_pattern, walsh_hadamard


def patterns(shape, order):
    rows = [hadamard_pattern(i, shape, order).ravel() for i in range(np.prod(shape))]
    return np.array(rows, int)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 4), (8, 4)])
def test_both_orders_hold_every_row_once(shape):
    count = np.prod(shape)
    natural, sequency = (patterns(shape, order) for order in ("natural", "sequency"))
    np.testing.assert_array_equal(natural, scipy.linalg.hadamard(count))
    np.testing.assert_array_equal((np.diff(sequency) != 0).sum(axis=1), np.arange(count))
    # ERRATA on Eq 5.15: N times the unit matrix.
    np.testing.assert_array_equal(sequency @ sequency.T, count * np.eye(count))


@pytest.mark.parametrize("count", [1, 2, 32, 64])
@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64])
def test_transform_is_the_product_with_the_matrix(count, kind):
    values = np.random.default_rng(count).integers(0, 4096, (count, 300)).astype(kind)
    found = walsh_hadamard(values)
    assert found.dtype == (np.float64 if kind is np.float64 else np.float32)
    np.testing.assert_array_equal(found, (scipy.linalg.hadamard(count) @ values.astype(float)).T)


def test_frames_of_a_series():
    binary = HadamardSeries((2, 4), display="binary", dark_frames=2)
    assert binary.frame_count == 10
    np.testing.assert_array_equal(binary.frame(0), np.ones((2, 4)))
    np.testing.assert_array_equal(2 * binary.frame(3) - 1.0, hadamard_pattern(3, (2, 4)))
    np.testing.assert_array_equal(binary.frame(9), np.zeros((2, 4)))
    both = HadamardSeries((2, 4), order="natural")
    assert both.frame_count == 16
    difference = both.frame(6).astype(int) - both.frame(7)
    np.testing.assert_array_equal(difference, hadamard_pattern(3, (2, 4), "natural"))


def test_what_is_no_power_of_two_is_refused():
    with pytest.raises(ValueError, match="60 × 64 = 3840 cells are no power of two.*such as 4096"):
        HadamardSeries((60, 64))
    with pytest.raises(ValueError, match="no power of two"):
        walsh_hadamard(np.ones((12, 2)))
    with pytest.raises(ValueError, match="there are 8 patterns; give 0 … 7"):
        hadamard_pattern(8, (2, 4))
    with pytest.raises(ValueError, match="frame 16 of 16: give 0 … 15"):
        HadamardSeries((2, 4)).frame(16)
    with pytest.raises(ValueError, match="dark_frames = -1"):
        HadamardSeries((2, 4), dark_frames=-1)
