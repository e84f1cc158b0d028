"""Comparisons of masks: what light is equal, and what a run finds and shows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from studies import tiny_masks as tiny

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.studies.mask_captures import ComparedMask, Seen, best_linear, capture
from thincam_jax.studies.mask_comparison import ComparedScene


@pytest.mark.thorough
def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="masks: 1 are given; synthesis fringe_scanning takes 4"):
        ComparedMask((tiny.zones(),), synthesis="fringe_scanning")
    comparison = tiny.comparison()
    with pytest.raises(ValueError, match="light: .* do not rise; give the weakest first"):
        dataclasses.replace(comparison, light=(1e3, 10.0))
    scenes = {"wide": ComparedScene(np.eye(28))}
    with pytest.raises(ValueError, match=r"scene wide: has \(28, 28\) pixels; give those of the"):
        dataclasses.replace(comparison, scenes=scenes)


@pytest.mark.thorough
def test_light_is_that_of_the_bare_sensor():
    """A white scene through a PSF of one over the field's shadow: the electrons asked for, and
    captures that share it have their parts."""
    setting, field = tiny.SETTING, tiny.FIELD
    whole = kernel_shape(setting.sensor.shape, field)
    white, key = jnp.ones((1, *field)), jax.random.key(0)
    one = ComparedMask((tiny.zones(),))
    four = ComparedMask(tuple(map(tiny.zones, tiny.PHASES)), synthesis="fringe_scanning")
    seen = capture(setting, one, jnp.ones((1, *whole)), white, 1e4, key)
    area = np.prod(field) * setting.pitch**2
    electrons = np.asarray(seen.channels[0, 0]) / area * 1e4
    np.testing.assert_allclose(electrons.mean(), 1e4, rtol=1e-3)
    np.testing.assert_allclose(electrons.var(), 1e4 + 9, rtol=0.1)
    np.testing.assert_allclose(seen.variance * (1e4 / area) ** 2, 1e4 + 9, rtol=1e-3)
    # Differences of two of four captures, each of a quarter of the light.
    seen = capture(setting, four, jnp.ones((4, *whole)), white, 1e4, key)
    expected = 2 * (2500 + 9) * (area / 2500) ** 2
    np.testing.assert_allclose(seen.variance, expected, rtol=1e-3)
    np.testing.assert_allclose(np.var(seen.channels), expected, rtol=0.1)
    np.testing.assert_allclose(seen.level, 1, rtol=0.01)  # which the differences do not tell


def test_linear_estimate_solves_its_equation(key):
    """Against the dense normal equations, of two cameras whose PSFs reach beyond the sensor."""
    shape, field = (9, 12), (7, 8)
    whole = kernel_shape(shape, field)
    kernels = jax.random.uniform(key, (2, *whole))
    cameras = [CropConvolution(h[None], 0.1, shape, field) for h in kernels]
    images = jax.random.uniform(key, (1, *field))
    channels = jnp.stack([camera(images[:, None])[:, 0] for camera in cameras], axis=1)
    variance, (a, b) = jnp.array([1e-3]), (3.0, 0.2)
    found = best_linear(cameras, Seen(channels, variance, jnp.array([0.4])), jnp.array([[a, b]]))
    units = jnp.eye(56).reshape(56, 1, *field)
    matrix = np.concatenate([np.asarray(c(units)).reshape(56, -1).T for c in cameras])
    basis = np.eye(56).reshape(56, *field)
    rough = np.concatenate([np.diff(basis, axis=n).reshape(56, -1).T for n in (1, 2)])
    uniform, g = matrix.sum(axis=1), np.asarray(channels).reshape(2, -1).ravel()
    normal = matrix.T @ matrix / 1e-3 + a * rough.T @ rough + b * np.eye(56)
    expected = np.linalg.solve(normal, matrix.T @ (g - 0.4 * uniform) / 1e-3) + 0.4
    np.testing.assert_allclose(found.ravel(), expected, atol=0.01)


@pytest.fixture(scope="module")
def result():
    return tiny.comparison().run()


@pytest.mark.thorough
def test_scores_keep_the_order_of_the_masks(result):
    weak, strong = result.comparison.light

    def score(mask, light, scene="photograph", estimate="total variation"):
        return result.scores[result.case(mask, scene, light, estimate=estimate)][0]

    for estimate in ("linear", "total variation"):
        names = ("lenslets", "contours", "MURA")
        lenslets, contours, code = (score(name, strong, estimate=estimate) for name in names)
        assert lenslets > contours > code
    for mask in result.comparison.masks:
        for scene in result.comparison.scenes:
            assert score(mask, strong, scene) > score(mask, weak, scene) - 0.1
    # Beside read noise, a pinhole's light is nothing.
    gaps = [
        score("pinhole", light, estimate="linear") - score("MURA", light, estimate="linear")
        for light in (weak, strong)
    ]
    assert gaps[0] < gaps[1]


@pytest.mark.thorough
def test_what_the_psf_says(result):
    strengths = result.strengths
    assert strengths["pinhole"].throughput == pytest.approx((48 / 744) ** 2, rel=0.05)
    assert strengths["MURA"].throughput == pytest.approx(0.5, rel=0.02)
    assert strengths["lenslets"].throughput == pytest.approx(1.0, rel=0.03)
    assert strengths["lenslets"].detail == pytest.approx(1 / 3, rel=0.3)  # of nine equal points
    for one in strengths.values():
        assert 0 <= one.weakest < one.flatness <= 1
    assert set(result.tau.values()) <= {1, 4}
    assert result.unfocused("MURA") > 0 and result.near("zone plate") < result.near("lenslets")


@pytest.mark.thorough
def test_tables_and_figures(result):
    # Masks × scenes × lights × distances × colours × estimates, and the wrong focus.
    assert len(result.scores) == 6 * 2 * (2 * 2 * 2 * 2 + 1)
    psnr, ssim = result.scores[result.case("MURA", "points", 1e5)]
    (row,) = (row for row in result.table().rows if row[0] == "MURA")
    assert row[-1] == f"{psnr:.1f} / {ssim:.2f}"
    for table in (result.table("linear"), result.strength_table(), result.cost_table()):
        assert [row[0] for row in table.rows] == list(result.comparison.masks)
        assert "nan" not in str(table) and "–" not in str(table)
    try:
        error, images = result.plot_error(), result.plot_images()
        assert [len(ax.lines) for ax in error.axes] == [6, 6]
        assert len(images.axes) == 6 * (2 + 5)
    finally:
        pyplot.close("all")
