"""What docs/theory/extremes.md quotes is what the tests hold."""

import numpy as np
import pytest
from extremes import EXTREMES, GRADIENTS, LOST

from helpers import ROOT


def documented(first: str) -> dict[str, list[str]]:
    """The rows of the table that begins with that cell, by their own first cell."""
    page = (ROOT / "docs/theory/extremes.md").read_text(encoding="utf-8")
    table = page[page.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    assert len({len(row) for row in rows}) == 1
    return {row[0]: row for row in rows[2:]}


def test_every_extreme_is_documented():
    """The pages' tables have all of them, in this order, and nothing else."""
    assert list(documented("extreme")) == [extreme.name for extreme in EXTREMES]
    assert len({extreme.name for extreme in EXTREMES}) == len(EXTREMES)
    assert list(documented("gradient at")) == list(GRADIENTS)


def check_quoted(cell: str, bound: float, floor: float) -> None:
    """*measured < bound*, two to three times that."""
    measured, quoted = (float(part) for part in cell.split(" < "))
    assert quoted == bound
    assert 2 * measured < bound < 3 * max(measured, floor)


@pytest.mark.parametrize("extreme", EXTREMES, ids=lambda extreme: extreme.name)
def test_documented_errors(extreme):
    """Each bound stands after the measured error, two to three times that, or nine eps."""
    *_, single_cell, double_cell = documented("extreme")[extreme.name]
    for dtype, cell in zip((np.float32, np.float64), (single_cell, double_cell), strict=True):
        check_quoted(cell, getattr(extreme, dtype.__name__), 3 * np.finfo(dtype).eps)


@pytest.mark.parametrize("name", GRADIENTS)
def test_documented_gradients(name):
    """As the values; bold is what is lost, a nought what is zero."""
    _, *cells = documented("gradient at")[name]
    for cell, bound in zip(cells, GRADIENTS[name], strict=True):
        if bound is None:
            assert cell == "0"
            continue
        assert ("**" in cell) == (bound > LOST)
        check_quoted(cell.replace("**", ""), bound, 0.0)
