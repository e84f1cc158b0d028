"""Refocusing studies: both objects are found, and are sharper in focus."""

import numpy as np
import pytest
from matplotlib import pyplot
from studies import tiny_refocus


@pytest.fixture(scope="module")
def study():
    return tiny_refocus.study()


@pytest.fixture(scope="module")
def result(study):
    texts = []
    result = study.run(lambda text, count: texts.append((text, count)))
    assert len(texts) == texts[0][1] == 4 + 13 + 2 * 2
    return result


@pytest.mark.thorough
def test_both_objects_are_found(result):
    assert list(result.objects) == ["near", "far"]
    for found in result.objects.values():
        # To a fifth of the depth of focus, 1.1 and 4.2 mm.
        depth = found.axial_resolution_mm
        assert found.found_mm == pytest.approx(found.distance_mm, abs=0.2 * depth)
        error = 100 * (found.found_mm / found.distance_mm - 1)
        assert found.error_percent == pytest.approx(error, abs=0.05)
        assert found.focus_contrast > 0.1
    near, far = (one.axial_resolution_mm for one in result.objects.values())
    assert 4 < near < far


def test_objects_are_better_in_focus(result):
    for method in result.methods.values():
        near, far = (method.focused_on_mm[t].psnr_db for t in ("20", "45"))
        assert near["near"] > far["near"] + 0.3
        assert far["far"] > near["far"] + 0.1
        assert method.captures == 4


def test_the_sweep_is_even_in_inverse_distance(study, result):
    distances = np.asarray(result.sweep.distances)
    assert distances[0] == pytest.approx(15) and distances[-1] == pytest.approx(90)
    np.testing.assert_allclose(np.diff(1 / distances), np.diff(1 / distances)[0], rtol=1e-3)
    assert float(result.sweep.slope) == pytest.approx(0.02 / 5)
    for name, found in result.objects.items():
        peak = distances[np.argmax(result.found.curve(name))]
        assert peak == pytest.approx(found.found_mm, rel=0.2)
    assert result.sharp.shape == study.field_shape(study.sweep_method)


def test_objects_stand_where_they_were_put(study):
    """An object's box in the projection: middle at d/t times its place, in pixels."""
    method = study.sweep_method
    rows, columns = study.field_shape(method)
    for placed in study.objects:
        scale = 5.0 / placed.distance / 0.02
        box = study.object_box(method, placed)
        middle = [(s.start + s.stop - 1) / 2 for s in box]
        wanted = [(rows - 1) / 2 + placed.y * scale, (columns - 1) / 2 + placed.x * scale]
        np.testing.assert_allclose(middle, wanted, atol=1.0)
        np.testing.assert_allclose([s.stop - s.start for s in box], placed.width * scale, atol=1.01)
        image = np.asarray(placed.plane.image)
        y, x = (np.arange(n) - (n - 1) / 2 for n in image.shape)
        pitch = float(placed.plane.width) / image.shape[1]
        centre = pitch * np.array([image.sum(1) @ y, image.sum(0) @ x]) / image.sum()
        np.testing.assert_allclose(centre, (placed.y, placed.x), atol=0.06 * placed.width)


def test_tables_findings_and_figure(result):
    assert [row[2] for row in result.table().rows] == [o.found_mm for o in result.objects.values()]
    rows = result.methods_table().rows
    assert [row[:3] for row in rows[:2]] == [(rows[0][0], 4, "20"), (rows[0][0], 4, "45")]
    assert result.findings()[0].startswith("near, placed at 20 mm, is sharpest at")
    assert result.findings()[-1].startswith("The objects stand 25 mm apart or more; the depth of")
    try:
        titles = [ax.get_title() for ax in result.plot().axes]
        assert titles[0].endswith("focused on 20 mm")
    finally:
        pyplot.close("all")
