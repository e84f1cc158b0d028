"""How pictures are laid out: what is read, not how it looks."""

import dataclasses

import numpy as np
import pytest
from studies import tiny

import thincam_jax as tc
from thincam_jax.imaging.targets import usaf1951
from thincam_jax.imaging.targets.usaf import usaf1951_elements
from thincam_jax.plot.studies import _by_synthesis, _pairs_of_axes, draw_responses, enlarged_part
from thincam_jax.studies import Limits, Response


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


def test_the_detail_of_a_chart_holds_its_fine_groups():
    """All sets of its second layer and none of the first, whose bars are four times as wide."""
    chart, picture = tiny.study().targets
    image = usaf1951((320, 320))
    fine, label = enlarged_part(image, chart)
    assert label == "fine groups, 20 mm"
    sets = [e for e in usaf1951_elements() if e.group in (0, 1)]
    assert {abs(np.subtract(e.centre, (-2.5 / 32, 2.25 / 32))).max() < 0.12 for e in sets} == {True}
    np.testing.assert_allclose(fine.sum(), usaf1951((320, 320))[95:175, 143:223].sum(), rtol=0.1)
    assert enlarged_part(image, picture)[1] == "middle 27 mm"


def test_panels_of_transfer_functions_share_frequencies_and_show_limits():
    study = tiny.study()
    limits = Limits(None, None, 9.0, 3.7)
    found = {
        m.name: Response(np.arange(50.0) / 4, np.linspace(1, 3 - 2 * n, 50), limits)
        for n, m in enumerate(study.methods)
    }
    panels = draw_responses(study, found).axes
    assert {ax.get_xlim() for ax in panels} == {(0, 1.3 * 10.8)}  # of the published limit
    # From 0 to 1, or to the largest where that is above 1.
    assert [ax.get_ylim()[1] > 1.05 for ax in panels] == [True, False]
    first, second = ([t.get_text() for t in ax.get_legend().get_texts()] for ax in panels)
    assert first == ["cut-off 9.0", "Nyquist 12.5", "published limit 10.8"]
    assert second == ["cut-off 9.0", "Nyquist 12.5"]


def test_methods_of_the_same_captures_and_sums_share_a_transfer_function():
    study = tiny.study()
    first = study.methods[0]
    twin = dataclasses.replace(first, name="twin")
    other = dataclasses.replace(study, methods=(*study.methods, twin))
    responses = {
        m.name: Response(np.arange(3.0), np.full(3, float(n)), Limits(None, None, 1.0, 1.0))
        for n, m in enumerate(other.methods)
    }
    panels = _by_synthesis(other, responses)
    assert [title for title, _ in panels] == [f"{first.name}; twin", study.methods[1].name]
    assert panels[0][1] is responses[first.name]
    # The same captures, but other sums of them.
    odd = dataclasses.replace(
        twin, name="1", synthesis="harmonics", harmonics=(1,), solver=tc.Wiener()
    )
    even = dataclasses.replace(twin, name="2", synthesis="separate", solver=tc.Wiener())
    both = dataclasses.replace(study, methods=(odd, even))
    either = {method.name: responses["twin"] for method in both.methods}
    assert len(_by_synthesis(both, either)) == 2
