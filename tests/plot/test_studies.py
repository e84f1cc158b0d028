"""How pictures are laid out: what is read, not how it looks."""

import dataclasses
import re

import numpy as np
import pytest
from studies import tiny

import thincam_jax as tc
from thincam_jax.imaging.targets import usaf1951
from thincam_jax.imaging.targets.usaf import usaf1951_elements
from thincam_jax.plot.studies import _by_synthesis, _pairs_of_axes, draw_responses, enlarged_part
from thincam_jax.studies.response import Response, ResponseLimits


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


def test_panels_of_transfer_functions_end_past_their_limits_and_go_to_1():
    """Each panel ends just past its limits; its title gives the largest value above 1."""
    study = tiny.study()
    limits = ResponseLimits(None, None, 9.0, 3.7)
    found = {
        m.name: Response(np.arange(50.0) / 4, np.linspace(1, 3 - 2 * n, 50), limits)
        for n, m in enumerate(study.methods)
    }
    figure = draw_responses(study, found)
    panels = figure.axes
    assert [ax.get_xlim()[1] for ax in panels] == pytest.approx([1.15 * 10.8, 1.15 * 9.0])
    assert {ax.get_ylim() for ax in panels} == {(0, 1.05)}
    first, second = (ax.get_title(loc="left") for ax in panels)
    assert re.fullmatch(r".*, up to \d\.\d\d at 12\.2", first) and "up to" not in second
    first, second = ([t.get_text() for t in ax.get_legend().get_texts()] for ax in panels)
    assert first == ["cut-off 9.0", "published limit 10.8"] and second == ["cut-off 9.0"]
    figure.draw_without_rendering()
    for ax in panels:  # beside the curves, not over them
        assert ax.get_legend().get_window_extent().x0 >= ax.get_window_extent().x1


def test_a_panel_without_limits_goes_past_the_nyquist_frequency():
    study = tiny.study()
    none = Response(np.arange(50.0) / 4, np.ones(50), ResponseLimits(None, None, 0.0, 0.0))
    panels = draw_responses(study, {m.name: none for m in study.methods}).axes
    assert panels[1].get_xlim()[1] == pytest.approx(1.08 * 0.5 / study.pitch)
    assert [t.get_text() for t in panels[1].get_legend().get_texts()] == [
        "cut-off 0.0",
        "Nyquist 12.5",
    ]


def test_methods_of_the_same_captures_and_sums_share_a_transfer_function():
    study = tiny.study()
    first = study.methods[0]
    twin = dataclasses.replace(first, name="twin")
    other = dataclasses.replace(study, methods=(*study.methods, twin))
    responses = {
        m.name: Response(np.arange(3.0), np.full(3, float(n)), ResponseLimits(None, None, 1.0, 1.0))
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
