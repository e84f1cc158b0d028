"""Units, ranges and choices stand at the fields, and are read from there."""

import dataclasses
import re
from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import pytest

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import (
    UNITS,
    FieldError,
    check_fields,
    choice,
    quantities,
    quantity,
    unchecked,
)
from thincam_jax.design.design import Design
from thincam_jax.units import KINDS, parse_quantity


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_read_in_the_unit_that_it_is_written_in(kind):
    assert KINDS[kind].unit in UNITS
    assert parse_quantity(f"0.25 {KINDS[kind].unit}", kind) == 0.25


@pytest.mark.parametrize(
    ("owner", "name", "unit", "kind"),
    [
        (tc.FresnelZoneAperture, "beta", "rad/mm^2", "curvature"),
        (tc.FresnelZoneAperture, "phase", "rad", "angle"),
        (tc.FresnelZoneAperture, "pixel_pitch", "mm", "length"),  # a parameter without a field
        (tc.FresnelZoneAperture, "fill_factor", "", ""),
        (tc.Sensor, "electrons", "electrons/mm^2", ""),
        (tc.Spectrum, "wavelengths", "mm", "wavelength"),
        (tc.PoissonGaussianNoise, "read_noise", "electrons", ""),
        (wg.SeeThroughCamera, "tilt", "rad", "angle"),
        (Design, "wavelength", "mm", "wavelength"),
    ],
)
def test_fields_tell_their_unit(owner, name, unit, kind):
    found = quantities(owner)[name]
    assert (found.unit, found.kind, found.name) == (unit, kind, name)


def test_metadata_of_a_field_is_its_quantity():
    fields = {field.name: field for field in dataclasses.fields(tc.FresnelZoneAperture)}
    beta, profile = (fields[name].metadata["converter"] for name in ("beta", "profile"))
    assert (beta.symbol, beta.positive, beta.label("β")) == ("rad/mm²", True, "β, rad/mm²")
    assert profile.choices == ("cosine", "intensity", "binary")


@pytest.mark.parametrize(
    ("one", "given", "message"),
    [
        (quantity("mm", positive=True), 0, "value = 0.0 mm is not positive; give value > 0 in mm"),
        (quantity("rad"), float("inf"), "value = inf rad is not finite"),
        (quantity("electrons", non_negative=True), -1, "is negative; give value >= 0 in electrons"),
        (quantity("mm", shape=(2,)), 1.0, r"has shape \(\); give an array of shape \(2,\) in mm"),
        (choice(("a", "b")), "c", "value = 'c' is unknown; choose one of 'a', 'b'"),
    ],
)
def test_refusals(one, given, message):
    with pytest.raises(ValueError, match=message):
        one(given)


def test_none_where_it_may_be_left_out():
    assert quantity("mm", optional=True)(None) is None
    with pytest.raises(TypeError, match="value = None is not a real number; give it in mm"):
        quantity("mm")(None)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0 mm"), (5.5e-3, "5.5 µm"), (jnp.asarray([5e-4, 6e-4]), "(500, 600) nm")],
)
def test_lengths_are_printed_in_the_unit_that_suits(value, text):
    assert unchecked("mm").text(value) == text


def test_traced_numbers_keep_their_unit():
    seen = []
    jax.jit(lambda x: seen.append(unchecked("rad").text(x)))(1.0)
    assert seen == ["? rad"]


def test_a_fault_between_fields_names_the_one_to_change():
    with pytest.raises(FieldError, match="bit_depth needs an exposure") as caught:
        tc.Sensor((3, 4), 0.01, bit_depth=8)
    assert caught.value.field == "bit_depth"


@dataclass(frozen=True)
class Lamps:
    """Lamps in a row."""

    lengths: Annotated[tuple[float, ...], quantity("mm", positive=True, many=True)] = (1.0, 2.0)
    share: Annotated[float, quantity(positive=True, most=1.0)] = 1.0
    level: Annotated[float, quantity("dB", least=-3.0, most=3.0)] = 0.0

    def __post_init__(self):
        check_fields(self)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"lengths": (1.0, -2.0)}, "lengths = -2.0 mm is not positive; give lengths > 0 in mm"),
        ({"share": 0.0}, "share = 0.0 is not positive; give share > 0"),
        ({"share": 1.5}, "share = 1.5 is out of range; give 0 < share <= 1"),
        ({"level": 4.0}, "level = 4.0 dB is out of range; give -3 to 3 dB"),
    ],
)
def test_records_check_the_quantities_of_their_fields(given, message):
    assert Lamps(lengths=()).lengths == ()
    with pytest.raises(ValueError, match=re.escape(message)):
        Lamps(**given)
    assert quantities(Lamps)["level"].most == 3.0


def test_a_fault_may_lie_in_an_entry_of_a_field():
    fault = FieldError("give less", "shots", 1, "width")
    assert (str(fault), fault.field, fault.place) == ("give less", "shots", ("shots", 1, "width"))
