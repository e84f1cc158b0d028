"""Scores of a method, their means over photographs and seeds, and an image of files."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from commands.reconstruct import simulated
from studies import tiny

import thincam_jax as tc
from thincam_jax._core.grids import Grid
from thincam_jax.measured import Preparation, Raw, prepare
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies import Method
from thincam_jax.studies import trials as module
from thincam_jax.studies.evaluate import Resolved, Scores, evaluate
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared
from thincam_jax.studies.result import method_response
from thincam_jax.studies.study import Target
from thincam_jax.studies.trials import (
    GainOverPhotographs,
    compare_trials,
    further_photographs,
    hold_out,
    simulate_trials,
)

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


def test_the_interval_is_that_of_the_mean():
    """Of 1,000 sets of twelve gains of 0.3 ± 0.2 dB it holds the mean in 95 %."""
    values = [0.1, 0.4, 0.25, 0.6]
    gain = GainOverPhotographs.of(values)
    low, high = scipy.stats.t.interval(0.95, 3, np.mean(values), scipy.stats.sem(values))
    assert (gain.mean, gain.low, gain.high) == pytest.approx((0.3375, low, high), abs=1e-4)
    assert str(gain) == f"+0.34 dB (95 %: {low:+.2f} to {high:+.2f})"
    random = np.random.default_rng(0)
    sets = [GainOverPhotographs.of(random.normal(0.3, 0.2, 12)) for _ in range(1000)]
    assert np.mean([one.low < 0.3 < one.high for one in sets]) == pytest.approx(0.95, abs=0.02)


def test_photographs_that_are_used_are_left_out():
    names = further_photographs(("camera", "coins"), 12)
    assert len(names) == 12 == len(set(names))
    assert not {"camera", "coins", "cat", "logo", "text"} & set(names)


def test_each_photograph_is_as_if_it_were_alone(monkeypatch):
    """With hardly any noise, whose key is the target's own."""
    monkeypatch.setattr(module, "_PIXELS", 60)
    study = replace(tiny.study(), noise=tc.GaussianNoise(120.0))
    found = hold_out(study, ("camera", "chelsea"))
    first, *others = study.methods
    assert found.photographs == ("camera", "chelsea")
    assert [*found.gains] == [method.name for method in others]
    distance, width = study.object_distance, study.targets[0].width
    for place, name in enumerate(found.photographs):
        target = Target.of_image(name, module._square(name), distance, width, "photograph")
        alone = simulate_trials(study, target, 1)
        for method in others:
            levels = [alone[one.name][0].psnr_db or 0.0 for one in (method, first)]
            expected = levels[0] - levels[1]
            assert found.gains[method.name].values[place] == pytest.approx(expected, abs=2e-3)


def scores(psnr, step):
    resolved = None if step is None else Resolved(step // 6, step % 6, 2.0 ** -(step / 6), 1.0)
    return Scores(psnr, 0.5, 0.1, resolved)


def test_gains_are_taken_seed_by_seed():
    trials = {
        "a": {"old": [scores(20.0, 7), scores(22.0, 8)], "new": [scores(20.5, 9), scores(22.9, 8)]}
    }
    compared = compare_trials(trials)
    assert compared["old"]["a"].gain_db is None
    gain = compared["new"]["a"].gain_db
    assert gain.values == [0.5, 0.9]
    assert gain.mean == 0.7
    assert gain.deviation == pytest.approx(np.std([0.5, 0.9], ddof=1), abs=1e-4)
    assert compared["new"]["a"].gain_elements.values == [2, 0]
    # Not resolved, or exact: no number is made up.
    trials["a"]["old"][0] = scores(None, None)
    compared = compare_trials(trials)
    assert compared["new"]["a"].gain_db is None
    assert compared["new"]["a"].gain_elements is None
    assert compared["old"]["a"].resolved_object_mm[0] is None


@pytest.mark.parametrize(
    ("betas", "phases"), [((25, 21), (0.0, 3 * np.pi / 2)), ((25, 23, 20), (0.0,))]
)
def test_contrasts_carry_all_but_the_common_part(betas, phases):
    """Σ|contrast|² = Σ|H|² − |ΣH|²/n, over all captures; also with one phase a shot."""
    exposures = tc.Exposures(betas, 3.0, **tiny.LIGHT).at_phases(phases)
    method = Method("one", exposures, tc.Wiener(), "contrasts", len(phases))
    study = tiny.study(methods=(method,))
    found = method_response(study, method)
    count = len(betas) * len(phases)
    each = [
        tc.otf(
            study.camera(exposure),
            wavelength=exposure.wavelength,
            object_distance=100.0,
            model="geometric",
            pixel_integration=False,
        )[24, 32:]
        for exposure in method.exposures
    ]
    assert len(each) == count
    profiles = np.stack(each)
    expected = (np.abs(profiles) ** 2).sum(0) - np.abs(profiles.sum(0)) ** 2 / count
    np.testing.assert_allclose(found.magnitude**2, expected, atol=1e-9 * expected.max())
    assert found.limits.first_zero_cycles_per_mm is None


NOISE = 20.0  # counts


@pytest.fixture(scope="module")
def prepared():
    """A PSF of spots and a capture of 12 bit of two discs, with noise of 20 counts."""
    light = simulated.psf()
    view = simulated.capture(simulated.scene()[1:2], light)[0]
    images = (simulated.counts(light, 3), simulated.counts(view, 10, noise=NOISE))
    psf, capture = (Raw(image.astype(np.uint16), bits=12) for image in images)
    return prepare(psf, capture, background=float(simulated.DARK), options=Preparation())


def test_noise_in_counts_of_a_raw_pixel(prepared):
    given, found = pixel_noise(prepared, NOISE), pixel_noise(prepared)
    assert given.counts == pytest.approx(NOISE) and given.found == "given"
    assert found.counts == pytest.approx(NOISE, rel=0.25) and found.found.startswith("estimated")
    assert found.deviation / found.counts == pytest.approx(given.deviation / given.counts)
    scale = 4095 * prepared.log.capture_divisor
    assert given.deviation == pytest.approx(NOISE / scale)


def test_the_image_is_the_middle_of_the_field(prepared):
    noise = pixel_noise(prepared)
    done = reconstruct_prepared(prepared, tc.Ridge(1.0), noise)
    rows, columns = simulated.SHAPE
    whole, image = done.image("full"), done.image()
    assert whole.shape == (1, 2 * rows - 1, 2 * columns - 1) and image.shape == (1, rows, columns)
    top, left = ((n - m) // 2 for n, m in zip(whole.shape[1:], image.shape[1:], strict=True))
    np.testing.assert_array_equal(image, whole[:, top : top + rows, left : left + columns])
    assert simulated.correlation(image[0], simulated.scene()[1]) > 0.6
    assert done.pixel_deviation == pytest.approx(noise.deviation, rel=1e-3)
    assert 0 < done.relative_residual < 0.3
