"""What is worth choosing, on tables made up for it."""

from matplotlib.figure import Figure

from thincam_jax.commands.accuracy.figures import _draw_times
from thincam_jax.commands.accuracy.psfs import mark_front


def worth_choosing(errors, seconds):
    rows = [{"true_error": e, "seconds": s} for e, s in zip(errors, seconds, strict=True)]
    mark_front(rows)
    return [row["worth_choosing"] for row in rows]


def test_made_up_table():
    # name: error, seconds
    table = {
        "fast and rough": (1.0, 0.1, True),
        "slower and rougher": (2.0, 0.2, False),
        "in between": (0.1, 0.3, True),
        "as accurate, slower": (0.1, 0.4, False),
        "no gain worth it": (0.096, 0.5, False),
        "exact": (0.0, 1.0, True),
        "exact, slower": (0.0, 2.0, False),
    }
    errors, seconds, expected = map(list, zip(*table.values(), strict=True))
    assert worth_choosing(errors, seconds) == expected
    assert worth_choosing(errors[::-1], seconds[::-1]) == expected[::-1]


def test_equal_times():
    assert worth_choosing([0.5, 0.1], [1.0, 1.0]) == [False, True]
    assert worth_choosing([0.1, 0.1], [1.0, 1.0]) == [True, False]


def test_nothing_and_one():
    assert worth_choosing([], []) == []
    assert worth_choosing([3.0], [1.0]) == [True]


def test_the_reference_is_beside_the_measured_ones_and_not_among_them():
    """It has no error of its own: no place on that axis, and none on the joined line."""
    names = ("model", "precision", "oversampling", "shape", "status", "seconds", "true_error")
    table = [
        ("geometric", "float32", None, [48, 64], "run", 1e-3, 0.1),
        ("paraxial", "float32", None, [48, 64], "run", 2e-3, 0.01),
        ("separable", "float64", None, [48, 64], "run", 5e-3, 0.0),
    ]
    rows = [dict(zip(names, row, strict=True), worth_choosing=row[-1] > 0) for row in table]
    camera = {"beta_rad_per_mm2": 25.0, "distance_mm": 3.0}
    results = {
        "psfs": rows,
        "settings": {"camera": camera, "study": "tiny"},
        "machine": {"device_kind": "cpu", "cores": 2},
    }
    ax = Figure().subplots()
    _draw_times(ax, results)
    *marks, joined, reference = ax.lines
    assert [tuple(mark.get_xydata()[0]) for mark in marks] == [(1e-3, 0.1), (2e-3, 0.01)]
    assert joined.get_xydata().tolist() == [[1e-3, 0.1], [2e-3, 0.01]]
    assert reference.get_xdata()[0] == 5e-3
    assert reference.get_transform() == ax.get_xaxis_transform()
