"""The axes of a sweep: syntax, units, linked entries, and what is refused."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sweep.point import read_axes

RAW = {
    "seed": 0,
    "mask": {"width": "2.0 mm"},
    "sensor": {"shape": [32, 48]},
    "methods": [
        {"shots": [{"beta": "25.0 rad/mm^2"}, {"beta": "21.0 rad/mm^2"}]},
        {"shots": [{"beta": "25.0 rad/mm^2"}]},
    ],
}


def values(text):
    (axis,) = read_axes([text], RAW)
    return axis.values


def fault(*texts):
    with pytest.raises(ConfigError) as caught:
        read_axes(texts, RAW)
    (line,) = str(caught.value).splitlines()
    return line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("seed=0:4:5", (0, 1, 2, 3, 4)),
        ("seed=5:8:1", (5,)),
        ("noise.snr_db=0:1:3", (0, 0.5, 1)),
        ("noise.snr_db=.1:.3:3", (0.1, 0.2, 0.3)),
        ("noise.snr_db=-10:10:3", (-10, 0, 10)),
        ("noise.snr_db=1e-3:1:4:log", (0.001, 0.01, 0.1, 1)),
        ("mask.width=1:2:3mm", ("1 mm", "1.5 mm", "2 mm")),
        ("wavelength=1:100:3:log um", ("1 um", "10 um", "100 um")),
        ("methods.0.shots.0.beta=15:30:2 rad/mm^2", ("15 rad/mm^2", "30 rad/mm^2")),
        ("seed=1,5", (1, 5)),
        ("mask.width=2 mm", ("2 mm",)),
        ("mask.width=1 mm, 15 um", ("1 mm", "15 um")),
        ("mask.width=1, 1.5, 2 mm", ("1 mm", "1.5 mm", "2 mm")),
        ("model=separable,geometric", ("separable", "geometric")),
        ("pixel_integration=true,false", (True, False)),
        ("sensor.shape=[32, 48],[64, 96]", ([32, 48], [64, 96])),
        ("sensor.bit_depth=null,8", (None, 8)),
        ("title=a:b", ("a:b",)),
    ],
)
def test_values(text, expected):
    found = values(text)
    assert found == expected
    assert [type(value) for value in found] == [type(value) for value in expected]


@given(
    low=st.integers(-1000, 1000),
    high=st.integers(-1000, 1000),
    tenths=st.booleans(),
    count=st.integers(2, 50),
)
def test_range_holds_both_ends_in_even_steps(low, high, tenths, count):
    low, high = (low / 10, high / 10) if tenths else (low, high)
    found = values(f"noise.snr_db={low}:{high}:{count}")
    assert len(found) == count
    assert (found[0], found[-1]) == (low, high)
    step = (high - low) / (count - 1)
    for index, value in enumerate(found):
        assert math.isclose(value, low + index * step, rel_tol=1e-11, abs_tol=1e-9)


@given(
    low=st.floats(1e-6, 1e6, allow_subnormal=False), high=st.floats(1e-6, 1e6), n=st.integers(3, 9)
)
def test_logarithmic_range_has_equal_ratios(low, high, n):
    found = values(f"noise.snr_db={low!r}:{high!r}:{n}:log")
    ratio = (high / low) ** (1 / (n - 1))
    for before, after in zip(found, found[1:], strict=False):
        assert math.isclose(after / before, ratio, rel_tol=1e-10)


def test_star_stands_for_every_entry_of_a_list():
    (axis,) = read_axes(["methods.*.shots.*.beta=1:2:2 rad/mm^2"], RAW)
    assert axis.path == "methods.*.shots.*.beta"
    assert axis.places == (
        ("methods", 0, "shots", 0, "beta"),
        ("methods", 0, "shots", 1, "beta"),
        ("methods", 1, "shots", 0, "beta"),
    )


NINES = "9," * 99


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("seed", "write it as path=lo:hi:n"),
        ("a..b=0:1:2", "write it as path=lo:hi:n"),
        ("seed=", "has no values"),
        ("seed=0:4", "write it as path=lo:hi:n"),
        ("seed=0:4:5:6", "write it as path=lo:hi:n"),
        ("seed=0:4:1000000000", "n is 1000000000; give from 1"),
        ("seed=0:4:3:log", "log needs both ends above zero"),
        ("mask.width=1 mm:2 mm:3", "a unit stands once, at the end"),
        ("title=[a", "put texts in quotes"),
        # Counted as in files.
        (f"seed=&a [{NINES}],&b [{'*a,' * 99}],[{'*b,' * 99}]", "entries (an alias counts as"),
        ("mask.*=1", "mask is no list"),
        ("methods.5.shots.*.beta=1", "methods.5.shots is no list"),
    ],
)
def test_refused(text, part):
    line = fault(text)
    assert line.startswith(f"--grid {text}: ")
    assert part in line


@pytest.mark.parametrize(
    ("first", "second", "entry"),
    [
        ("methods.0.shots.1.beta=1", "methods.*.shots.*.beta=2", "methods.0.shots.1.beta"),
        ("noise.snr_db=1", "noise={snr_db: 3}", "noise"),
        ("mask={width: 1 mm}", "mask.width=1 mm", "mask.width"),
    ],
)
def test_entry_that_two_axes_set(first, second, entry):
    line = fault(first, second)
    assert line == f"--grid {second}: {entry} is set by --grid {first} too; give it once"
