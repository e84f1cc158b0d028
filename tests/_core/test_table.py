"""Tables as Markdown, and what they refuse."""

import pytest

from thincam_jax._core.table import Table


def test_numbers_texts_and_gaps_as_markdown():
    table = Table(("method", "PSNR\ndB", "n"), [("A", 1.26, 3), ("B\nβ", None, "–")], (1,), "All")
    assert str(table).splitlines() == [
        "All",
        "",
        "| method | PSNR dB |   n |",
        "| ------ | ------: | --: |",
        "| A      |     1.3 |   3 |",
        "| B β    |       – |   – |",
    ]


def test_a_row_fits_its_headings_and_fractions_have_digits():
    with pytest.raises(ValueError, match="2 cells under 3 headings"):
        Table(("a", "b", "c"), [("1", "2")])
    with pytest.raises(ValueError, match="0.5 in column 2: give `digits`"):
        str(Table(("a", "b", "c"), [("1", 1.0, 0.5)], (1,)))
