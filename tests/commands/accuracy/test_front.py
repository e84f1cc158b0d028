"""What is worth choosing, on tables made up for it."""

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
