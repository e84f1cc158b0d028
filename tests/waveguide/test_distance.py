"""Distances from the parallax of ghosts: known ones come back, and what cannot be told is not."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import camera

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import um
from thincam_jax.waveguide.distance import (
    _judged,
    _search,
    find_distances_of,
    picture_likelihood,
    typical_variance,
)

SHAPE, CELLS, ENDS = (44, 36), 90, (300.0, 1100.0)


@functools.cache
def through():
    screen = camera().screen
    return wg.SeeThroughCamera(screen, tc.Sensor(SHAPE, 48 * um), 6.0, 10.0)


@functools.cache
def picture(name="camera"):
    return resize(sample_image(name, linear=True), (CELLS, CELLS))


def clean(image, distance, width=1.5):
    """Its capture, of the same angular size at all distances; wider than the field it fills it."""
    field = 0.352 * (10 + distance)
    below = max(0.5 * field * (width - 1.06), 0)
    plane = wg.ObjectPlane(image.shape, distance, field * width, (9.1 + below, 0.0))
    return np.asarray(wg.system_operator(through(), plane)(jnp.asarray(image)), float)


def noisy(capture, snr_db=50, seed=0):
    deviation = np.sqrt(np.mean(capture**2)) * 10 ** (-snr_db / 20)
    return capture + deviation * np.random.default_rng(seed).standard_normal(capture.shape)


@functools.cache
def found():
    """Results of all captures, whose ghosts are traced once."""
    text = np.random.default_rng(0).uniform(size=SHAPE)
    captures: dict[object, np.ndarray] = {
        d: noisy(clean(picture(), d)) for d in (330.0, 550.0, 700.0)
    }
    captures["noisier"] = noisy(clean(picture(), 550.0), 35)
    captures["dark ground"] = noisy(clean(picture(), 480.0, 0.7))
    captures["blank"] = noisy(clean(np.ones((CELLS, CELLS)), 550.0))
    captures["blank without noise"] = clean(np.ones((CELLS, CELLS)), 550.0)
    captures["noise"] = 1 + 0.1 * text
    captures["beyond"] = noisy(clean(picture(), 5000.0))
    captures["before"] = noisy(clean(picture(), 170.0))
    results = find_distances_of(through(), list(captures.values()), ENDS)
    return dict(zip(captures, results, strict=True))


class TestDistance:
    @pytest.mark.parametrize("distance", [330.0, 550.0, 700.0])
    def test_a_known_distance_comes_back_within_its_error(self, distance):
        one = found()[distance]
        assert one.status == "determined"
        assert abs(one.distance - distance) < 3 * one.standard_error
        assert one.standard_error < 0.06 * distance

    def test_an_object_before_a_dark_ground(self):
        one = found()["dark ground"]
        assert one.status == "determined"
        assert abs(one.distance - 480.0) < 3 * one.standard_error

    def test_errors_grow_with_the_noise_and_with_the_square_of_the_distance(self):
        errors = {key: one.standard_error for key, one in found().items()}
        assert errors["noisier"] > errors[550.0]
        assert errors[700.0] > 2 * errors[330.0]

    @pytest.mark.parametrize("name", ["blank", "blank without noise", "noise", "beyond", "before"])
    def test_what_has_no_parallax_or_is_out_of_range_is_not_determined(self, name):
        assert found()[name].status != "determined"

    def test_a_repetition_in_the_picture_is_not_taken_for_a_ghost(self):
        """Lines over the whole field, at the ghost's displacement and others, level and tilted."""
        y, x = np.indices((CELLS, CELLS)) * (66 / CELLS)  # pixels of the capture
        captures = []
        for period, tilt in ((3.93, 0.35), (4.1, 0.0), (4.71, 0.35), (8.1, 0.0)):
            lines = 0.5 + 0.3 * np.sign(np.sin(2 * np.pi * (y + tilt * x) / period))
            captures.append(noisy(clean(lines, 550.0), 40))
        for one in find_distances_of(through(), captures, ENDS):
            wrong = abs(one.distance - 550.0) > 55.0
            assert one.status != "determined" or not wrong

    def test_the_profile(self):
        one = found()[550.0]
        assert (np.diff(one.distances) > 0).all() and one.distances[[0, -1]] == pytest.approx(ENDS)
        assert one.log_likelihood.max() == 0 and one.lead[one.log_likelihood.argmax()] == 0
        assert (abs(one.plausible - one.distance) < 0.15 * one.distance).all()
        assert found()["blank"].plausible.size > 5

    @pytest.mark.parametrize(
        "changes, advice",
        [
            ({"nearest": 900.0, "farthest": 300.0}, "give nearest below it"),
            ({"nearest": 500.0, "farthest": 510.0}, "moves by more than 2"),
            ({"nearest": 20.0}, "give a larger nearest distance"),
        ],
    )
    def test_a_misuse_is_named_with_what_to_do(self, changes, advice):
        with pytest.raises(ValueError, match=advice):
            wg.distance_from_ghosts(through(), **{"capture": np.ones(SHAPE)} | changes)


class TestJudgement:
    def beside(self, parts, opposite):
        """Log-likelihoods with those of ghosts on the opposite side."""
        return np.stack([parts, opposite], axis=-1).reshape(len(parts), -1)

    def judged(self, peak, tiles=30):
        """Of tiles with a common peak among the distances, and noise of their own."""
        search = _search(through(), ENDS, 2)
        steps = np.arange(search.distances.size)
        own = np.random.default_rng(1).standard_normal((tiles, steps.size))
        parts = 3 * np.exp(-((steps - peak) ** 2) / 8) + 0.3 * own
        return search, _judged(search, self.beside(parts, 0 * parts))

    def test_a_peak_of_all_tiles_is_determined_and_one_at_an_end_is_not(self):
        search, one = self.judged(10.0)
        assert one.status == "determined"
        assert one.distance == pytest.approx(
            float(search.distances[10]), abs=2 * one.standard_error
        )
        assert self.judged(0.0)[1].status == "at_end"

    def test_a_peak_of_one_tile_is_not(self):
        search = _search(through(), ENDS, 2)
        parts = np.zeros((30, search.distances.size))
        parts[7, 8:13] = 20, 35, 40, 35, 20
        one = _judged(search, self.beside(parts, 0 * parts))
        assert one.status == "ambiguous" and np.isinf(one.standard_error)

    def test_a_peak_on_both_sides_is_a_pattern_of_the_picture(self):
        search, _ = self.judged(10.0)
        steps = np.arange(search.distances.size)
        own = np.random.default_rng(1).standard_normal((30, steps.size))
        parts = 3 * np.exp(-((steps - 10.0) ** 2) / 8) + 0.3 * own
        assert _judged(search, self.beside(parts, parts[::-1])).status == "ambiguous"


class TestPictureLikelihood:
    def test_a_ghost_costs_likelihood(self):
        image = resize(sample_image("camera", linear=True), (60, 50))
        doubled = image.copy()
        doubled[:-9] += 0.15 * image[9:]
        scale = typical_variance(image)
        assert (
            picture_likelihood(image, scale).sum() > picture_likelihood(doubled, scale).sum() + 10
        )

    def test_the_unit_is_free(self):
        image = resize(sample_image("camera", linear=True), (24, 30))
        log = picture_likelihood(image, 1e-3) - picture_likelihood(10 * image, 0.1)
        np.testing.assert_allclose(log, np.log(10.0), atol=1e-6)
