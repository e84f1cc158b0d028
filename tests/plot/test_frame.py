"""Letters of a figure, as large on a report's page as one can read."""

import pytest
from matplotlib.text import Text

from thincam_jax.plot.frame import as_png, drawing


@pytest.mark.parametrize("width", [3.0, 8.5, 16.0])
def test_letters_have_twelve_pixels_where_a_page_shows_them(width):
    """110 pixels an inch, but no more than 850 in all; wide figures are shown smaller."""
    figure, axes = drawing((width, 3.0), 1, 2)
    for ax in axes:
        ax.plot([0, 1], label="line")
        ax.set_title("title", fontsize=6)
        ax.legend(fontsize=5)
    assert as_png(figure).startswith(b"\x89PNG")
    shown = min(110, 850 / width) / 72
    sizes = [text.get_fontsize() * shown for text in figure.findobj(Text) if text.get_text()]
    assert len(sizes) > 8 and min(sizes) > 11.99


def test_titles_do_not_run_into_each_other():
    """Six beside each other are small on a page: theirs are broken, after commas."""
    figure, axes = drawing((16.5, 3.5), 1, 6)
    for ax in axes:
        ax.set_title("conventional, d = 5.0 mm\n15.7 dB")
    as_png(figure)
    assert {ax.get_title() for ax in axes} == {"conventional,\nd\xa0=\xa05.0\xa0mm\n15.7\xa0dB"}
    boxes = [ax.title.get_window_extent() for ax in axes]
    assert all(a.x1 < b.x0 for a, b in zip(boxes, boxes[1:], strict=False))
