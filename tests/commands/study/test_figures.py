"""How pictures are laid out: what is read, not how it looks."""

import dataclasses

import numpy as np
import pytest
from commands.study import tiny

from thincam_jax.commands.study.figures import _by_synthesis, _pairs_of_axes
from thincam_jax.commands.study.response import Response


@pytest.mark.parametrize(
    ("count", "rows", "columns"), [(3, 2, 3), (6, 2, 6), (7, 4, 4), (10, 4, 5)]
)
def test_many_methods_go_into_several_bands(count, rows, columns):
    """At most six beside each other, each detail below its picture, nothing twice."""
    figure, wholes, details = _pairs_of_axes(count, 0.7)
    assert len(wholes) == len(details) == count
    grid = wholes[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == (rows, columns)
    places = set()
    for whole, detail in zip(wholes, details, strict=True):
        above, below = (ax.get_subplotspec() for ax in (whole, detail))
        assert below.rowspan.start == above.rowspan.start + 1
        assert below.colspan.start == above.colspan.start
        places.add((above.rowspan.start, above.colspan.start))
    assert len(places) == count
    hidden = [ax for ax in figure.axes if not ax.axison]
    assert len(hidden) == rows * columns - 2 * count


def test_methods_of_the_same_captures_and_sums_share_a_transfer_function(tmp_path):
    study = tiny.built(tmp_path)
    first = study.methods[0]
    twin = dataclasses.replace(first, name="twin")
    other = dataclasses.replace(study, methods=(*study.methods, twin))
    responses = {
        m.name: Response(np.arange(3.0), np.full(3, float(n)), {})
        for n, m in enumerate(other.methods)
    }
    panels = _by_synthesis(other, responses)
    assert [title for title, _ in panels] == [f"{first.name}; twin", study.methods[1].name]
    assert panels[0][1] is responses[first.name]
