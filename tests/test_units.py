"""Units: the constants, and what `parse_quantity` accepts, returns and refuses."""

import math

import pint
import pytest

from thincam_jax import units
from thincam_jax.units import deg, mrad, nm, parse_quantity, um


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("180 mm", 180.0),
        ("500 nm", 500 * nm),
        ("532 nm", 532 * nm),
        ("5.5 um", 5.5 * um),
        ("5.5um", 5.5 * um),
        ("5.5 µm", 5.5 * um),  # micro sign
        ("5.5 μm", 5.5 * um),  # Greek mu
        ("0.25 m", 250.0),
        ("25 cm", 250.0),
        ("  -1.5e-3   mm ", -1.5e-3),
        ("1 inch", 25.4),
    ],
)
def test_length_is_in_millimetres(text, value):
    assert parse_quantity(text, "length") == pytest.approx(value, rel=1e-15, abs=0)


@pytest.mark.parametrize("wavelength", [400, 457.9, 500, 532, 633])
def test_decimal_prefixes_are_exact(wavelength):
    assert parse_quantity(f"{wavelength} nm", "length") == wavelength * nm


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("61.2 deg", 61.2 * deg),
        ("61.2°", 61.2 * deg),
        ("-30 arcmin", -0.5 * deg),
        ("5 mrad", 5 * mrad),
        ("1.07 rad", 1.07),
        ("0.5 turn", math.pi),
    ],
)
def test_angle_is_in_radians(text, value):
    assert parse_quantity(text, "angle") == pytest.approx(value, rel=1e-14, abs=0)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("25 rad/mm^2", 25.0),
        ("25 rad/mm**2", 25.0),
        ("25 rad/mm²", 25.0),
        ("25 rad mm^-2", 25.0),
        ("25 /mm^2", 25.0),
        ("25/mm^2", 25.0),
        ("25 1/mm^2", 25.0),
        ("2500 rad/cm^2", 25.0),
        ("25e6 rad/m^2", 25.0),
        ("25 mrad/um^2", 25e3),
    ],
)
def test_curvature_is_in_radians_per_square_millimetre(text, value):
    assert parse_quantity(text, "curvature") == pytest.approx(value, rel=1e-14, abs=0)


def test_units_that_files_have_most_are_those_of_pint():
    """To the last bit; they are read without it."""
    for kind, names in units._COMMON.items():
        for unit in names:
            by_pint = parse_quantity(f"61.2{unit}", kind)  # without a blank
            assert parse_quantity(f"61.2 {unit}", kind) == by_pint


def test_quantity_of_any_registry_is_accepted():
    registry = pint.UnitRegistry()
    assert parse_quantity(registry.Quantity(5.5, "um"), "length") == 5.5 * um
    assert parse_quantity(registry.Quantity(90, "deg"), "angle") == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        (180, "length", '180 has no unit: write a length such as "180 mm"'),
        ("1" * 5000, "length", "1" * 80 + '…" is not a length: write a length'),
        ("25", "curvature", 'write a curvature such as "25 rad/mm^2"'),
        ("25 s", "length", '"25 s" is a time, not a length: write a length such as "180 mm"'),
        ("2 mm", "angle", '"2 mm" is a length, not an angle'),
        ("5 %", "angle", '"5 %" is a pure number, not an angle'),
        ("25 rad/mm", "curvature", "is an angular spatial frequency, not a curvature"),
        ("5 mm rad", "length", "is a quantity in millimeter * radian, not a length"),
        (
            "25 mmm",
            "length",
            'has the unknown unit "mmm": write a length such as "500 nm", "5.5 um"',
        ),
        ("nan mm", "length", '"nan mm" is not finite'),
        ("1e308 km", "length", '"1e308 km" is not finite'),
        ("mm", "length", '"mm" does not begin with a number'),
        ("1,5 m", "length", '"1,5 m" is not a number and a unit'),
        ("5\n;mm", "length", '"5 ;mm" is not a number and a unit'),
        (None, "length", "None is not a length"),
        ("180 mm", "width", "'width' is not a kind of quantity: use one of"),
    ],
)
def test_refusal_says_what_to_write_in_one_line(text, kind, message):
    with pytest.raises(ValueError) as caught:
        parse_quantity(text, kind)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_text_is_read_and_not_evaluated():
    for text in ("9**9**9**9 mm", "5 mm**9**9**9", "2 * (3 mm)", "5 mm**99999999"):
        with pytest.raises(ValueError, match="is not a number and a unit"):
            parse_quantity(text, "length")


def test_quantity_must_be_one_real_number_with_a_unit():
    quantity = pint.UnitRegistry().Quantity
    with pytest.raises(ValueError, match="not one real number"):
        parse_quantity(quantity([5.0, 6.0], "mm"), "length")
    with pytest.raises(ValueError, match="not one real number"):
        parse_quantity(quantity(5j, "mm"), "length")
    with pytest.raises(ValueError, match="5 has no unit"):
        parse_quantity(quantity(5), "length")
