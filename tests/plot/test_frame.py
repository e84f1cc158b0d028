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
