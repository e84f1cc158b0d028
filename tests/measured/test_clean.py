import numpy as np
import pytest

from thincam_jax.measured.preparation import centre_psf, clean


def test_each_channel_is_cut_at_its_own_level():
    psf = np.array([[[8.0, 1.0, 0.5, 0.0]], [[0.8, 0.1, 0.05, 0.2]]])
    found, record = clean(psf, np.zeros(2), threshold=0.125)
    np.testing.assert_array_equal(found, [[[8.0, 1.0, 0, 0]], [[0.8, 0.1, 0, 0.2]]])
    assert record.zeroed == 2
    np.testing.assert_allclose(record.light_removed, 0.55 / 10.65, rtol=1e-12)
    np.testing.assert_allclose(record.level, [1.0, 0.1])


def test_noise_level_counts_where_it_is_the_larger():
    psf = np.array([[[8.0, 1.0, 0.5, 0.2]]])
    for noise, kept in ((0.3, 2), (0.1, 3), (0.01, 4)):
        found, record = clean(psf, np.array([noise]), 0.02, 3)
        assert np.count_nonzero(found) == kept
        np.testing.assert_allclose(record.level, [max(0.16, 3 * noise)])
    found, record = clean(psf, np.array([0.3]))
    np.testing.assert_array_equal(found, psf)
    assert record.zeroed == record.light_removed == 0


@pytest.mark.parametrize("by", ["centroid", "peak", "symmetry"])
@pytest.mark.parametrize("size", [(9, 12), (8, 11)])
def test_a_single_pixel_comes_to_the_origin_of_a_dft(by, size):
    psf = np.zeros((2, *size), np.float32)
    psf[:, 1, 8] = 3, 1
    found, record = centre_psf(psf, by)
    assert np.argwhere(found[0]).tolist() == [[size[0] // 2, size[1] // 2]]
    assert record.shift == (size[0] // 2 - 1, size[1] // 2 - 8)
    assert record.light_lost == 0
    # In the place where a DFT has its origin, by another library:
    assert np.argwhere(np.fft.ifftshift(found[1])).tolist() == [[0, 0]]


def test_the_three_centres_of_a_lopsided_pair():
    psf = np.zeros((1, 11, 21))
    psf[0, 4, 3], psf[0, 4, 7] = 1.0, 1.5
    found = {by: centre_psf(psf, by)[1].found for by in ("centroid", "peak", "symmetry")}
    np.testing.assert_allclose(found["centroid"], [4, (3 + 1.5 * 7) / 2.5])
    assert found["peak"] == (4, 7)
    assert found["symmetry"] == (4, 5)  # of 1 at 3 + 3, 2·1.5 at 3 + 7 and 1.5² at 7 + 7


def test_symmetry_is_not_drawn_aside_by_a_bright_side():
    """A symmetric pattern of irregular dots with one more: the centroid moves, this does not."""
    generator = np.random.default_rng(9)
    half = (generator.random((15, 19)) < 0.2) * 1.0
    pattern = half + half[::-1, ::-1]
    psf = np.zeros((1, 40, 50))
    psf[0, 3:18, 20:39] = pattern
    psf[0, 38, 2] = 10.0
    centre, record = centre_psf(psf, "symmetry")
    assert record.found == (10.0, 29.0)
    assert abs(centre_psf(psf, "centroid")[1].found[0] - 10.0) > 1
    # 19.5 − 10 and 24.5 − 29, rounded up; the dot leaves the array.
    assert record.shift == (10, -4)
    np.testing.assert_array_equal(centre[0, 13:28, 16:35], pattern)
    np.testing.assert_allclose(record.light_lost, 10 / psf.sum())
