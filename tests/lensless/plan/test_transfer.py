"""Transfer functions and spectra of a plan, which PSFs are computed, and what the sensor sees."""

import numpy as np
import pytest
import scipy.signal
from lensless.plan.scenes import camera

import thincam_jax as tc
from thincam_jax.lensless.method import CLOSED, PsfMethod, models_of
from thincam_jax.lensless.plan.make import fit, order_of_columns
from thincam_jax.lensless.plan.seen import (
    TransferProbe,
    _rounded_up,
    centred,
    crop_factor,
    image_spectrum,
    sample_frequencies,
    waves,
)
from thincam_jax.units import nm

KERNEL = (45, 70)


def direct(h, frequencies):
    """Σ h e^{−2πj(vy+ux)} over the samples."""
    down = np.exp(-2j * np.pi * np.outer(frequencies.v, centred(h.shape[0])))
    across = np.exp(-2j * np.pi * np.outer(centred(h.shape[1]), frequencies.u))
    return np.einsum("km,mn,nk->k", down, np.asarray(h), across)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(m, marks=[pytest.mark.thorough] * (m != "closed_form"))
        for m in models_of(camera().mask)
        if m in CLOSED
    ],
)
@pytest.mark.parametrize("average", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_exact_and_quick_agree_with_the_sum_over_the_psf(model, average):
    own = camera()
    frequencies = sample_frequencies(max(KERNEL))
    probe = TransferProbe(own, KERNEL, frequencies)
    h = tc.psf(
        own.on_grid(tc.Grid(KERNEL, own.sensor.pitch)),
        wavelength=500 * nm,
        object_distance=250.0,
        model=PsfMethod(model, "float64", average),
    )
    expected = direct(h, frequencies)
    scale = np.abs(expected).max()
    method = PsfMethod(model, "float64", average)
    exact = probe.exact(500 * nm, 250.0, method)
    np.testing.assert_allclose(exact, expected, atol=1e-11 * scale)
    quick = probe.quick(500 * nm, 250.0, method)
    np.testing.assert_allclose(quick, expected, atol=2e-5 * scale)


def test_six_nodes_serve_to_compare():
    """6 nodes a pixel in place of 24 move H by 0.9 % here, with pixels as large as 44 µm."""
    own = camera()
    frequencies = sample_frequencies(max(KERNEL))
    probe = TransferProbe(own, KERNEL, frequencies)
    methods = (PsfMethod("separable", "float32", True, nodes=n) for n in (6, 24))
    few, many = (probe.quick(500 * nm, 250.0, method) for method in methods)
    energy = np.sum(frequencies.weights * np.abs(many) ** 2)
    moved = np.sum(frequencies.weights * np.abs(few - many) ** 2)
    assert 0 < np.sqrt(moved / energy) < 1.2e-2


def test_sizes_are_rounded_up_by_a_quarter_at_most():
    for count in [1, 31, 32, 33, 129, 1000, 1323, 5000]:
        assert count <= _rounded_up(count) <= max(64, 1.25 * count)
    assert len({_rounded_up(n) for n in range(1024, 2048)}) <= 5


@pytest.mark.parametrize("longest", [1, 7, 200, 16384])
def test_weights_are_the_area_of_the_band(longest):
    found = sample_frequencies(longest)
    assert found.weights.sum() == pytest.approx(1.0)
    assert (found.weights > 0).all()
    assert (np.abs(found.v) < 0.5).all() and (found.u >= 0).all() and (found.u < 0.5).all()
    lowest = np.hypot(found.v, found.u).min()
    assert lowest < 0.25 / longest


def test_energy_is_that_of_the_image():
    """Parseval, by sampling: a box's energy lies at low frequencies, a texture's everywhere."""
    random = np.random.default_rng(1)
    box = np.zeros((1, 70, 50))
    box[:, 10:50, 5:40] = 1.0
    texture = random.normal(size=(1, 70, 50))
    estimates = []
    for image in (box, texture):
        ratios = []
        for seed in range(10):
            found = sample_frequencies(70, seed)
            energy = np.sum(found.weights * np.abs(image_spectrum(image, found)) ** 2)
            ratios.append(energy / np.sum(image**2))
        estimates.append(ratios)
    means, spread = np.mean(estimates, axis=1), np.std(estimates, axis=1)
    np.testing.assert_allclose(means, 1.0, atol=0.06)
    assert (spread < 0.2).all()  # of one draw: what the plan's margin of 1.5 must hold


def test_spectrum_is_the_centred_fourier_sum():
    image = np.random.default_rng(2).normal(size=(2, 5, 8))
    found = sample_frequencies(8)
    k = 37
    y, x = np.meshgrid(centred(5), centred(8), indexing="ij")
    phase = np.exp(-2j * np.pi * (found.v[k] * y + found.u[k] * x))
    np.testing.assert_allclose(
        image_spectrum(image, found)[:, k], (image * phase).sum(axis=(1, 2)), rtol=1e-12
    )


def test_waves_are_cosine_and_sine_and_end_with_the_indices():
    frequencies = np.array([0.1, 0.37])
    found = waves(frequencies, centred(5), 8)
    expected = np.exp(-2j * np.pi * np.outer(centred(5), frequencies))
    np.testing.assert_allclose(found[:5, :2] + 1j * found[:5, 2:], expected, rtol=1e-13)
    assert (found[5:] == 0).all()


def columns_of_rank(rank, count, random):
    """Complex columns, each a real combination of a few."""
    basis = random.normal(size=(40, rank)) + 1j * random.normal(size=(40, rank))
    return basis @ random.normal(size=(rank, count))


def test_as_many_columns_as_the_rank_reproduce_all():
    columns = columns_of_rank(4, 19, np.random.default_rng(0))
    order = order_of_columns(columns)
    assert sorted(order) == list(range(19))
    chosen = columns[:, order[:4]]
    for column in columns.T:
        weights = fit(chosen, column)
        np.testing.assert_allclose(chosen @ weights, column, atol=1e-10)
    worse = columns[:, order[:3]]
    missed = [np.linalg.norm(worse @ fit(worse, c) - c) / np.linalg.norm(c) for c in columns.T]
    assert max(missed) > 0.05


def test_the_largest_column_comes_first():
    random = np.random.default_rng(1)
    columns = columns_of_rank(6, 6, random)
    columns[:, 4] *= 50
    assert order_of_columns(columns)[0] == 4


def test_weights_are_real():
    """A column times j is no multiple of it: images cannot be mixed with complex weights."""
    column = np.array([1.0 + 2.0j, -0.5j])
    np.testing.assert_allclose(fit(column[:, None], 1j * column), [0.0], atol=1e-14)


@pytest.mark.parametrize("width", [1.0, 2.5, 9.0])
@pytest.mark.parametrize("shape", [(40, 61), (90, 30)])
def test_factor_is_that_of_a_box_convolution(width, shape):
    pitch, distance = 0.05, 130.0
    mask = tc.FresnelZoneAperture(25.0, width=width)
    camera = tc.LenslessCamera(mask, tc.Sensor(shape, pitch), 6.5)
    image = np.random.default_rng(0).uniform(size=(1, 25, 33))
    image[:, 8:] *= 3
    scale = 1 + 6.5 / distance
    kernel = [s + f - 1 for s, f in zip(shape, image.shape[1:], strict=True)]
    inside = [np.abs(np.arange(k) - (k - 1) / 2) * pitch <= width * scale / 2 for k in kernel]
    whole = scipy.signal.fftconvolve(image[0], np.outer(*inside).astype(float))
    rows, columns = (f - 1 for f in image.shape[1:])
    caught = whole[rows : rows + shape[0], columns : columns + shape[1]]
    expected = np.linalg.norm(whole) / np.linalg.norm(caught)
    assert crop_factor(camera, distance, image) == pytest.approx(expected, rel=0.05)


def test_a_sensor_that_sees_nothing_has_no_factor():
    """The shadow falls beside the kernel's grid."""
    mask = tc.FresnelZoneAperture(25.0, width=1.0, centre=(50.0, 0.0))
    camera = tc.LenslessCamera(mask, tc.Sensor((10, 12), 0.05), 6.5)
    assert crop_factor(camera, 250.0, np.ones((1, 4, 5))) == np.inf
