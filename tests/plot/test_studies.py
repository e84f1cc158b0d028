"""How pictures are laid out: what is read, not how it looks."""

import dataclasses

import numpy as np
from studies import tiny

import thincam_jax as tc
from thincam_jax.imaging.targets import usaf1951
from thincam_jax.imaging.targets.usaf import usaf1951_elements
from thincam_jax.plot.studies import _by_synthesis, enlarged_part
from thincam_jax.studies.result import Response, ResponseLimits


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
