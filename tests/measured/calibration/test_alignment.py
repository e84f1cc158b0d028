import json

import numpy as np
import pytest
import scipy

from thincam_jax.measured import MeasurementError
from thincam_jax.measured.calibration.alignment import Alignment, fit_alignment, locate_mark

SHAPE, WIDE = (40, 56), (72, 88)  # of a frame and of a PSF: ±16 pixels to search
DISPLAY = (60, 80), 0.5
SHOWN = np.array([[x, y] for y in (-10.0, 0.0, 10.0) for x in (-15.0, -5.0, 5.0, 15.0)])
HOMOGRAPHY = np.array([[0.98, -0.08, 3.0], [0.09, 0.97, -2.0], [4e-4, -3e-4, 1.0]])
SIMILARITY = np.array([[0.97, -0.1, 3.0], [0.1, 0.97, -2.0], [0.0, 0.0, 1.0]])


def psf():
    """Blobs, as smooth as a PSF that its pixels resolve."""
    points = np.random.default_rng(1).random(WIDE) > 0.97
    return scipy.ndimage.gaussian_filter(points.astype(float), 1.6)


def frame(shift, light=1.0):
    """The PSF moved by (x, y) pixels, by interpolation of its samples."""
    moved = scipy.ndimage.shift(psf(), shift[::-1], order=5)
    return light * moved[16:-16, 16:-16]


def applied(matrix, points):
    found = np.c_[points, np.ones(len(points))] @ matrix.T
    return found[:, :2] / found[:, 2:]


def seen(matrix, error, seed=0):
    random = np.random.default_rng(seed)
    places = applied(matrix, SHOWN) + error * random.standard_normal(SHOWN.shape)
    return [(place, error**2 * np.eye(2)) for place in places]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.3, -5.8), (-11.25, 9.6)])
def test_a_shift_is_found_to_a_fraction_of_a_pixel(shift):
    """Also under a uniform background, and where a part has left the frame."""
    found, covariance = locate_mark(200 + frame(shift, 50.0), psf())
    assert np.abs(found - shift).max() < 0.01
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_a_disc_is_matched_by_the_psf_that_it_blurs():
    y, x = np.indices((13, 13)) - 6
    disc = (np.hypot(y, x) < 4.0).astype(float)
    seen = scipy.signal.fftconvolve(psf(), disc, "same")
    seen = scipy.ndimage.shift(seen, (1.7, 2.4), order=5)[16:-16, 16:-16]
    left = [np.linalg.det(locate_mark(seen, psf(), radius)[1]) for radius in (0.0, 4.0)]
    assert np.abs(locate_mark(seen, psf(), 4.0)[0] - (2.4, 1.7)).max() < 0.02
    assert left[1] < 0.5 * left[0]


def test_stated_errors_of_shifts_are_those_of_fifty_frames():
    scores = []
    for seed in range(50):
        random, shift = np.random.default_rng(seed), (3.3, -5.8)
        light = frame(shift, 200.0)  # shot noise: not the same in all pixels
        noisy = light + np.sqrt(np.maximum(light, 0) + 4) * random.standard_normal(SHAPE)
        found, covariance = locate_mark(noisy, psf())
        scores.append((found - shift) / np.sqrt(np.diag(covariance)))
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2  # by chance 0.07


@pytest.mark.parametrize(
    ("kind", "matrix"), [("similarity", SIMILARITY), ("homography", HOMOGRAPHY)]
)
def test_a_map_is_found_with_its_errors(kind, matrix):
    """Without error exactly; with it within the standard errors that it states, of 50 seeds."""
    corners = np.array([[-20.0, -15.0], [20.0, 15.0], [0.0, 0.0]])
    exact = fit_alignment(DISPLAY, SHOWN, seen(matrix, 1e-6), kind, 0.5)
    assert np.abs(exact(corners) - applied(matrix, corners)).max() < 1e-5
    scores = []
    for seed in range(50):
        found = fit_alignment(DISPLAY, SHOWN, seen(matrix, 0.05, seed), kind, 0.5)
        scores.append((found(corners) - applied(matrix, corners)) / found.errors(corners))
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.15


def test_marks_that_do_not_agree_are_left_out_until_too_few_do():
    marks = seen(HOMOGRAPHY, 0.01)
    marks[3], marks[7] = None, (marks[7][0] + 8.0, marks[7][1])
    found = fit_alignment(DISPLAY, SHOWN, marks, "homography", 0.5)
    assert found.used == 10 and found.marks == 12
    line = "11 of 12 marks were found and 2 lie within 0.001 mm of a similarity, which takes 3"
    with pytest.raises(MeasurementError, match=line):
        fit_alignment(DISPLAY, SHOWN, seen(HOMOGRAPHY, 0.05)[:-1] + [None], "similarity", 1e-3)
    with pytest.raises(MeasurementError, match="4 of 12 marks were found and 0 lie"):
        fit_alignment(DISPLAY, SHOWN, marks[-4:] + [None] * 8, "homography", 0.5)


def test_a_picture_is_placed_where_the_model_has_it():
    """Its quarters, as the display's pixels see them through the map."""
    found = fit_alignment(DISPLAY, SHOWN, seen(HOMOGRAPHY, 1e-6), "homography", 0.5)
    picture = np.kron([[255, 0], [0, 128]], np.ones((4, 6))).astype(np.uint8)
    levels = found.place(picture, width=24.0)
    assert levels.shape == (60, 80) and levels.dtype == np.uint8
    rows, columns = np.indices((60, 80)).reshape(2, -1)
    x, y = found(0.5 * np.c_[columns - 39.5, rows - 29.5]).T
    clear = (np.abs(x) > 1) & (np.abs(y) > 1) & (np.maximum(np.abs(x) / 12, np.abs(y) / 8) < 0.9)
    wanted = np.where((x < 0) & (y < 0), 255, np.where((x > 0) & (y > 0), 128, 0))
    assert np.array_equal(levels.ravel()[clear], wanted[clear])
    assert not levels[np.reshape(np.maximum(np.abs(x) / 12, np.abs(y) / 8) > 1.1, (60, 80))].any()


def test_a_file_is_read_back_and_another_one_refused(tmp_path):
    path = tmp_path / "alignment.json"
    found = fit_alignment(DISPLAY, SHOWN, seen(HOMOGRAPHY, 0.05), "homography", 0.5)
    found.save(path)
    again = Alignment.load(path)
    assert str(again) == str(found) and again.shape == (60, 80)
    assert np.array_equal(again(SHOWN), found(SHOWN))
    path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"unknowns": [1]}), "utf-8")
    with pytest.raises(ValueError, match="holds no alignment of a display"):
        Alignment.load(path)
