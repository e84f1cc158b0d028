"""The chart against the definition of MIL-STD-150A, and its drawing against exact areas."""

from itertools import combinations, pairwise

import numpy as np
import pytest

from thincam_jax.imaging.targets import usaf1951
from thincam_jax.imaging.targets.usaf import line_pair, usaf1951_elements

STANDARD_WIDTH = 64.0  # mm; group -2, element 1 then has 0.25 line pairs/mm


def box(element):
    """(top, bottom, left, right) of a set of 5 by 5 bar widths."""
    (y, x), half = element.centre, 2.5 * element.bar
    return y - half, y + half, x - half, x + half


def test_layers_hold_an_even_and_an_odd_group_in_both_orientations():
    elements = usaf1951_elements(layers=2)
    labels = {(e.group, e.element, e.orientation) for e in elements}
    assert len(elements) == len(labels) == 2 * 24
    assert {e.group for e in elements} == {-2, -1, 0, 1}
    assert {e.element for e in elements} == set(range(1, 7))


def test_standard_line_pairs():
    """Line pairs/mm from the table of the standard: 0.25 at -2/1, 1.00 at 0/1, 1.78 at 0/6, ..."""
    table = {(-2, 1): 0.250, (-2, 6): 0.445, (-1, 1): 0.500, (-1, 4): 0.707, (0, 1): 1.00}
    table |= {(0, 6): 1.78, (1, 3): 2.52, (3, 6): 14.25, (2, 5): 6.35}
    found = {(e.group, e.element): 1 / line_pair(e, STANDARD_WIDTH) for e in usaf1951_elements(3)}
    for label, frequency in table.items():
        assert found[label] == pytest.approx(frequency, rel=3e-3)
    for (group, element), frequency in found.items():
        assert frequency == pytest.approx(2 ** (group + (element - 1) / 6), rel=1e-12)


def test_nothing_overlaps_and_a_margin_stays_free():
    boxes = [box(e) for e in usaf1951_elements(3)]
    for a, b in combinations(boxes, 2):
        gap = max(a[0] - b[1], b[0] - a[1], a[2] - b[3], b[2] - a[3])
        narrower = min(a[1] - a[0], b[1] - b[0]) / 5
        assert gap > 1.99 * narrower  # at least two bars of the finer one stay free
    assert min(0.5 - np.abs(b).max() for b in boxes) >= 2 / 32 - 1e-12


def test_the_layout_is_the_standard_one():
    """Even group: 1 at the lower right, 2-6 down the left. Odd group: 1-6 down the right."""
    where = {(e.group, e.element): e for e in usaf1951_elements(2) if e.orientation == "vertical"}
    centre = {key: e.centre for key, e in where.items()}
    for even in (-2, 0):
        left = [centre[even, e] for e in range(2, 7)]
        right = [centre[even + 1, e] for e in range(1, 7)]
        for column in (left, right):
            assert all(lower[0] > upper[0] for upper, lower in pairwise(column))
        assert max(x for _, x in left) < min(x for _, x in right)
        assert centre[even, 1][0] > max(y for y, _ in right)  # below the right column
        assert centre[even, 1][1] > max(x for _, x in left)
    outer = [box(e) for (group, _), e in where.items() if group < 0]
    inner = [box(e) for (group, _), e in where.items() if group >= 0]
    assert min(b[2] for b in inner) > min(b[3] for b in outer)  # the next layer lies in the middle
    assert max(b[1] for b in inner) < max(b[0] for b in outer)


def test_the_centroid_is_that_of_the_elements():
    """Pixel centres at (i - (n-1)/2): the first moment along each axis, at odd and even sizes.

    A half-covered pixel counts at its centre, hence the tolerance; half a pixel would be 3e-3.
    """
    pieces = [(15 * e.bar**2, *e.centre) for e in usaf1951_elements(1)]
    pieces.append(((5 / 32) ** 2, 9.5 / 32, -2.0 / 32))  # the solid square
    area, y, x = np.array(pieces).T
    for shape in [(200, 301), (151, 150)]:
        image = usaf1951(shape, layers=1)
        rows, columns = (np.arange(n) - (n - 1) / 2 for n in shape)
        width = min(shape)
        found_y = (image.sum(axis=1) @ rows) / image.sum() / width
        found_x = (image.sum(axis=0) @ columns) / image.sum() / width
        assert found_y == pytest.approx(area @ y / area.sum(), abs=1e-4)
        assert found_x == pytest.approx(area @ x / area.sum(), abs=1e-4)


def test_first_group_only_labels():
    standard, other = usaf1951_elements(2), usaf1951_elements(2, first_group=4)
    assert [(e.centre, e.bar) for e in standard] == [(e.centre, e.bar) for e in other]
    assert [e.group + 6 for e in standard] == [e.group for e in other]
    with pytest.raises(ValueError, match="first_group = 1"):
        usaf1951_elements(2, first_group=1)
