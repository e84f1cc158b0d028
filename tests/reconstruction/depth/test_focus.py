"""Focus measures against NumPy and SciPy, and what makes them measures of focus."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage as ndimage
from reconstruction.rig import unchecked

from helpers import count_traces, finite_difference, quick
from thincam_jax.reconstruction.depth.focus import MEASURES, focus_measure, gaussian_average


def picture(shape=(31, 44), seed=1):
    rng = np.random.default_rng(seed)
    return ndimage.gaussian_filter(rng.normal(size=shape), 1.5) + 0.3


def plain(image, measure, region):
    """The measures in SciPy's words, without smoothing."""
    if measure == "laplacian_variance":
        return ndimage.laplace(image, mode="nearest")[region].var()
    slopes = [ndimage.sobel(image, axis, mode="nearest") / 8 for axis in (0, 1)]
    length = np.hypot(*slopes)[region]
    if measure == "gradient_energy":
        return np.mean(length**2)
    return np.sqrt(np.mean(length**2)) / np.mean(length)


@pytest.mark.parametrize("measure", MEASURES)
def test_values_are_those_of_scipy(measure):
    image = picture()
    region = np.zeros(image.shape, bool)
    region[:19, 7:] = True
    whole = np.ones(image.shape, bool)
    expected = plain(image, measure, whole)
    assert float(focus_measure(image, measure, smoothing=0)) == pytest.approx(expected, rel=1e-10)
    part = focus_measure(image, measure, smoothing=0, region=region)
    assert float(part) == pytest.approx(plain(image, measure, region), rel=1e-10)
    assert float(part) != pytest.approx(expected, rel=1e-3)


def test_gaussian_average_is_scipys_inside_and_keeps_constants():
    image = picture((60, 71))
    inner = (slice(16, -16), slice(16, -16))
    found = np.asarray(gaussian_average(jnp.asarray(image), 2.5))
    expected = ndimage.gaussian_filter(image, 2.5, truncate=6)
    np.testing.assert_allclose(found[inner], expected[inner], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(gaussian_average(jnp.full((9, 14), 0.7), 3), 0.7, rtol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
def test_map_is_large_where_the_picture_is_sharp(measure):
    """The left half in focus, the right half blurred; the map's mean weights make the number."""
    rng = np.random.default_rng(3)
    sharp = (ndimage.gaussian_filter(rng.normal(size=(40, 81)), 2) > 0).astype(float)
    blurred = ndimage.gaussian_filter(sharp, 2)
    image = np.where(np.arange(81) < 40, sharp, blurred)
    values = np.asarray(focus_measure(image, measure, smoothing=0.5, window=4.0))
    assert values.shape == image.shape
    assert np.median(values[:, :30]) > 1.2 * np.median(values[:, 52:])


@pytest.mark.parametrize("measure", MEASURES)
def test_blur_lowers_every_measure(measure):
    sharp = np.zeros((40, 53))
    sharp[10:28, 12:30] = 1
    blurred = ndimage.gaussian_filter(sharp, 2)
    assert float(focus_measure(sharp, measure)) > 1.1 * float(focus_measure(blurred, measure))


def test_sparsity_is_free_of_scale_and_one_for_nothing():
    image = picture()
    first = focus_measure(image, "gradient_sparsity")
    assert float(focus_measure(7.3 * image + 2, "gradient_sparsity")) == pytest.approx(float(first))
    assert float(focus_measure(np.full((9, 12), 0.5), "gradient_sparsity", smoothing=0)) == 1


@pytest.mark.parametrize("measure", quick(MEASURES, 1))
def test_slope_jit_and_batch(measure):
    images = jnp.stack([jnp.asarray(picture(seed=s)) for s in (1, 2)])
    counted = count_traces(lambda image: focus_measure(image, measure))
    compiled = jax.jit(counted)
    each = [float(compiled(image)) for image in images]
    assert counted.traces == 1
    np.testing.assert_allclose(focus_measure(images, measure), each, rtol=1e-10)
    mapped = jax.vmap(lambda image: focus_measure(image, measure, window=3.0))(images)
    np.testing.assert_allclose(mapped, focus_measure(images, measure, window=3.0), rtol=1e-10)
    direction = jnp.asarray(picture(seed=5))
    slope = finite_difference(compiled, images[0], direction, 1e-3)
    gradient = jax.jit(jax.grad(lambda i: focus_measure(i, measure)))
    found = np.sum(gradient(images[0]) * direction)
    assert float(found) == pytest.approx(float(slope), rel=1e-6)


def test_slope_of_an_even_picture_is_finite():
    for measure in MEASURES:
        slope = jax.jit(jax.grad(lambda i, m=measure: focus_measure(i, m)))(np.full((8, 11), 0.5))
        assert np.isfinite(np.asarray(slope)).all()


def test_single_precision_is_kept():
    image = picture().astype(np.float32)
    for measure in MEASURES:
        found = focus_measure(jnp.asarray(image), measure)
        assert found.dtype == jnp.float32
        exact = focus_measure(image.astype(float), measure)
        assert float(found) == pytest.approx(float(exact), rel=1e-4)


@pytest.mark.parametrize(
    ("settings", "part"),
    [
        ({"smoothing": -1.0}, "smoothing = -1.0 pixels"),
        ({"window": 0}, "window = 0 holds no pixels"),
        ({"region": np.zeros((31, 44), bool)}, "region holds no pixel"),
        ({"region": np.ones((44, 31), bool)}, "region has shape"),
        ({"region": np.ones((31, 44), bool), "window": 3.0}, "not both"),
    ],
)
def test_faults_are_refused(settings, part):
    with unchecked(), pytest.raises(ValueError, match=part):
        focus_measure(picture(), **settings)
