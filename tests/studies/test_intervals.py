"""Intervals that hold for pictures which did not calibrate them, and those that cannot."""

import dataclasses
import itertools

import numpy as np
import pytest

from helpers import quick
from thincam_jax.studies.intervals import (
    Intervals,
    Levels,
    PixelSample,
    cross_validated,
    least_pictures,
)

SHAPE = (2, 14, 23)
GAIN, OFFSET = np.array([4.0, 0.5])[:, None, None], np.array([1.0, -2.0])[:, None, None]


def pictures(seed, count, errors=0.1, varied=0.5):
    """Images in units of their own, whose errors grow with the light and vary by picture."""
    rng, pairs = np.random.default_rng(seed), []
    for _ in range(count):
        truth = rng.uniform(0, 1, SHAPE) ** 3
        own = errors * np.exp(varied * rng.standard_normal())
        light = truth + own * np.sqrt(truth) * rng.standard_normal(SHAPE)
        pairs.append(((light - OFFSET) / GAIN, truth))
    return pairs


def samples(pairs, count=None, levels: Levels = "common"):
    return [PixelSample.of(image, truth, count, levels) for image, truth in pairs]


@pytest.mark.parametrize(
    ("count", "levels"), quick(itertools.product([9, 20, 40], ["own", "common"]), 1, 2)
)
def test_as_many_pixels_are_inside_as_promised(count, levels):
    """Of other pictures, over calibrations; few pictures make the intervals wider than needed."""
    found = []
    for seed in range(40):
        made = Intervals.calibrated(samples(pictures(seed, count), 60, levels))
        others = samples(pictures(1000 + seed, 10), None, levels)
        found += [made.coverage(one) for one in others]
    error = np.std(np.reshape(found, (40, 10)).mean(axis=1)) / 40**0.5
    assert np.mean(found) > 0.9 - 2 * error
    # On average the share of the rule itself is promised: at most 1/(n + 1) more is inside.
    assert np.mean(found) < 0.9 + 1 / (count + 1) + 2 * error


def test_ends_are_light_about_the_image_and_wider_where_it_is_bright():
    known = pictures(0, 20)
    made = Intervals.calibrated(samples(known))
    image, truth = pictures(1, 1)[0]
    (lower, upper), (one,) = made.of(image), samples([(image, truth)])
    assert lower.shape == SHAPE
    inside = np.mean((lower <= truth) & (truth <= upper))
    assert inside == pytest.approx(made.coverage(one), abs=1e-12)
    assert np.mean(upper - lower) == pytest.approx(made.width(one))
    for channel in range(2):  # the line that brings all images closest to the truths
        seen, light = (np.ravel([pair[n][channel] for pair in known]) for n in (0, 1))
        line = np.polyfit(seen, light, 1)
        middle = (lower + upper)[channel] / 2
        np.testing.assert_allclose(middle, np.polyval(line, image[channel]))
    width, bright = upper - lower, truth > 0.5
    assert width[bright].mean() > 2 * width[truth < 0.05].mean()
    assert made.probability == 0.9 and made.pictures == 20


def test_own_levels_leave_gain_and_offset_of_each_picture_open():
    pairs = pictures(0, 20)
    changed = [(3 * image - 7 * n, 0.1 * truth + n) for n, (image, truth) in enumerate(pairs)]
    made, other = (Intervals.calibrated(samples(one, None, "own")) for one in (pairs, changed))
    np.testing.assert_allclose(other.factor, made.factor, rtol=1e-6)
    np.testing.assert_allclose(other.parts, made.parts, rtol=1e-6)
    image, truth = pictures(1, 1)[0]
    ends, moved = made.of(image), made.of(3 * image - 2)
    np.testing.assert_allclose(moved, 3 * np.asarray(ends) - 2)
    np.testing.assert_allclose(np.mean(ends, axis=0), image)
    (one,) = samples([(image, truth)], None, "own")
    assert np.ptp(one.image, axis=1) == pytest.approx(1, abs=0.3)
    # The truth at the levels that bring it closest to the image.
    levelled = []
    for seen, known in zip(image, truth, strict=True):
        levelled.append(np.polyval(np.polyfit(known.ravel(), seen.ravel(), 1), known))
    inside = (ends[0] <= levelled) & (levelled <= ends[1])
    assert np.mean(inside) == pytest.approx(made.coverage(one))
    # Nothing is inside the intervals of common levels.
    common = Intervals.calibrated(samples(pairs))
    assert np.mean([common.coverage(two) for two in samples(changed[1:])]) < 0.2


def test_what_is_expected_narrows_them():
    """Beside intervals of one width, of the same pictures and as many pixels inside."""
    pairs = pictures(0, 40, varied=0.0)
    made = Intervals.calibrated(samples(pairs))
    plain = dataclasses.replace(made, parts=(1.0, 0.0, 0.0))
    ratios = np.concatenate([plain._ratios(one).ravel() for one in samples(pairs)])
    inside = np.mean([made.coverage(one) for one in samples(pairs)])
    plain = dataclasses.replace(plain, factor=float(np.quantile(ratios, inside)))
    others = samples(pictures(5, 10, varied=0.0))
    widths = [np.mean([one.width(other) for other in others]) for one in (made, plain)]
    assert widths[0] < 0.85 * widths[1]


def test_they_do_not_hold_for_what_they_were_not_calibrated_for():
    made = Intervals.calibrated(samples(pictures(0, 40)))
    assert np.mean([made.coverage(one) for one in samples(pictures(1, 20, 0.3))]) < 0.7
    moved = [(image + 2, truth) for image, truth in pictures(1, 20)]
    assert np.mean([made.coverage(one) for one in samples(moved)]) < 0.5


def test_each_picture_is_judged_by_others():
    pairs = pictures(0, 20)
    pairs[3] = pairs[3][0], 5 + 100 * np.random.default_rng(0).random(SHAPE)  # like no other
    covered, width = cross_validated(samples(pairs, 100))
    assert len(covered) == len(width) == 20
    assert covered[3] < 0.5 and np.mean([*covered[:3], *covered[4:]]) > 0.85
    assert cross_validated(samples(pictures(0, 11))) == ([], [])
    assert len(cross_validated(samples(pictures(0, 12)))[0]) == 12
    grey = [(image[:1], truth[:1]) for image, truth in pictures(0, 6)]
    assert cross_validated(samples([*pictures(0, 6), *grey])) == ([], [])


def test_samples_are_kept_to_six_digits():
    (one,) = samples(pictures(0, 1), 50)
    assert one.image.shape == one.contrast.shape == one.truth.shape == (2, 50)
    (kept,) = PixelSample.of_rows([{"pixels": one.as_lists()}, {"psnr_db": 3.0}])
    assert kept.levels == "common"
    for name in ("image", "contrast", "truth"):
        np.testing.assert_allclose(getattr(kept, name), getattr(one, name), rtol=1e-5)
    # Sampled pixels are those of the whole picture.
    (whole,) = samples(pictures(0, 1))
    assert whole.image.shape == (2, 14 * 23)
    assert set(one.contrast.ravel()) <= set(whole.contrast.ravel())


def test_a_file_and_what_is_refused(tmp_path):
    made = Intervals.calibrated(samples(pictures(0, 12)), 0.8)
    path = tmp_path / "intervals.json"
    path.write_text(made.as_json(), "utf-8")
    assert Intervals.load(path) == made
    path.write_text("{}", "utf-8")
    with pytest.raises(ValueError, match="holds no intervals; give a file of 'thincam evaluate'"):
        Intervals.load(path)
    assert (least_pictures(0.9), least_pictures(0.8), least_pictures(0.95)) == (9, 4, 19)
    with pytest.raises(ValueError, match="8 pictures; 90% take at least 9"):
        Intervals.calibrated(samples(pictures(0, 8)))
    with pytest.raises(ValueError, match="give one between 0 and 1"):
        Intervals.calibrated(samples(pictures(0, 12)), 1.0)


def test_images_without_errors_or_contrast():
    """Exact ones have intervals of nearly no width; uniform ones have no gain."""
    exact = [(truth, truth) for _, truth in pictures(0, 10)]
    made = Intervals.calibrated(samples(exact))
    assert made.coverage(samples(exact)[0]) > 0.9 and made.width(samples(exact)[0]) < 1e-6
    uniform = [(np.ones(SHAPE), truth) for _, truth in pictures(0, 10)]
    for known in (samples(uniform, None, "own"), samples(uniform)):
        made = Intervals.calibrated(known)
        assert np.isfinite([*made.gain, *made.offset, *made.parts, made.factor]).all()
        assert made.coverage(known[0]) > 0.85
