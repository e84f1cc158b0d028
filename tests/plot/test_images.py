"""Figures of `tc.plot`, and the picture that a result shows of itself in a notebook."""

import io

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import skimage.io

import thincam_jax as tc
from thincam_jax.plot.frame import as_png
from thincam_jax.plot.images import draw_result
from thincam_jax.reconstruction.result import Reconstruction

RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(size=(9, 13))


def result(image, pitch=None) -> Reconstruction:
    return Reconstruction(jnp.asarray(image), None if pitch is None else jnp.asarray(pitch))


def test_images_are_compared_with_the_truth():
    found = result(2 * IMAGE + 0.1 * RNG.normal(size=IMAGE.shape))
    figure = tc.plot.compare({"scene": IMAGE, "ridge": found}, truth="scene")
    titles = [ax.get_title() for ax in figure.axes]
    assert titles[0] == "scene" and titles[1].startswith("ridge, 2") and titles[1].endswith(" dB")
    for colours in (np.stack([IMAGE] * 3), np.stack([IMAGE] * 3, axis=-1)):  # (y, x, 3): a file's
        (panel,) = tc.plot.compare({"colour": colours}).axes
        assert panel.images[0].get_array().shape == (9, 13, 3)
    for images, truth in (({}, None), ({"a": IMAGE}, "b"), ({"a": IMAGE, "b": IMAGE[1:]}, "a")):
        with pytest.raises(ValueError, match="give (images by name|the truth on the same pixels)"):
            tc.plot.compare(images, truth=truth)


@pytest.mark.parametrize("rows", [5, 13, 20])  # wide, square and high
def test_titles_and_labels_lie_on_the_figure(rows):
    image = RNG.uniform(size=(rows, 13))
    figure = tc.plot.compare({"scene": image, "capture": IMAGE, "image": result(image, 0.1)})
    figure.draw_without_rendering()
    for ax in figure.axes:
        box = ax.get_tightbbox()
        assert box.x0 >= 0 and box.y0 >= 0
        assert box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height


@pytest.mark.parametrize(
    ("shape", "pitch", "shown", "widths"),
    [
        ((9, 13), None, (9, 13), [None]),
        ((3, 9, 13), 0.1, (9, 13, 3), [1.3]),  # colours
        ((3, 9, 13), [0.1, 0.2, 0.3], (9, 13), [1.3, 2.6, 3.9]),  # planes
        ((2, 9, 13), 0.1, (9, 13), [1.3, 1.3]),
        ((20, 9, 13), None, (9, 13), [None] * 16),
    ],
)
def test_a_result_shows_itself_on_axes(shape, pitch, shown, widths):
    linear = RNG.uniform(size=shape)
    found = result(linear, pitch)
    figure = draw_result(found)
    for ax, width in zip(figure.axes, widths, strict=True):
        image = ax.images[0]
        assert image.get_array().shape == shown and ax.axison
        assert ax.get_xlabel() == ("x (mm)" if width else "x (pixels)")
        assert not width or np.ptp(image.get_extent()[:2]) == pytest.approx(width)
        assert len(ax.get_xticks()) > 1 and len(ax.get_yticks()) > 1
    first = linear[0] if len(widths) > 1 else np.moveaxis(linear, 0, -1 if len(shape) > 2 else 0)
    levels = np.asarray(figure.axes[0].images[0].get_array())
    assert np.corrcoef(first.ravel() ** (1 / 2.2), levels.ravel())[0, 1] > 0.99
    assert 5 <= figure.get_figwidth() <= 10 and figure.get_suptitle()[:18] == (
        "the first 16 of 20" if shape[0] == 20 else ""
    )


def test_a_notebook_gets_the_figure_of_a_result_and_none_stays_open():
    from matplotlib import pyplot

    found = result(IMAGE, 0.1)
    shown = found._repr_png_()
    assert shown == as_png(draw_result(found)) and not pyplot.get_fignums()
    height, width, _ = skimage.io.imread(io.BytesIO(shown)).shape
    assert width == 550 and 350 < height < 500  # 5 inches


def test_a_capture_lies_on_its_sensor_in_mm():
    sensor = tc.Sensor((9, 13), 0.02)
    grey, colour = tc.plot.capture(IMAGE, sensor), tc.plot.capture(np.stack([IMAGE] * 3), 0.02)
    for figure in (grey, colour):
        assert figure.axes[0].images[0].get_extent() == pytest.approx([-0.13, 0.13, 0.09, -0.09])
        assert figure.axes[0].get_xlabel() == "x (mm)"
    assert grey.axes[1].get_ylabel() == "pixel value"
    with pytest.raises(ValueError, match="pitch = 5.5 mm is no pixel"):
        tc.plot.capture(IMAGE, 5.5)


def test_a_notebook_shows_a_figure_once(monkeypatch):
    """Whether IPython shows it as a value or at the end of a cell, it is not open afterwards."""
    from matplotlib import pyplot

    monkeypatch.setattr(matplotlib, "get_backend", lambda: "inline")
    figure = tc.plot.capture(IMAGE, 0.02)
    with pytest.raises(NotImplementedError):
        figure._ipython_display_()
    assert not pyplot.get_fignums()
    assert figure._repr_png_()[:4] == b"\x89PNG"
