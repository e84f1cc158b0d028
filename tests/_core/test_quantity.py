"""Units, ranges and choices of fields; how values and tables are printed."""

import re
from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
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
from thincam_jax._core.table import Table
from thincam_jax.measured.calibration.psf_fit import PsfFit
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.units import KINDS, nm, parse_quantity, um


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_read_in_the_unit_that_it_is_written_in(kind):
    assert KINDS[kind].unit in UNITS
    assert parse_quantity(f"0.25 {KINDS[kind].unit}", kind) == 0.25


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


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0 mm"), (5.5e-3, "5.5 µm"), (jnp.asarray([5e-4, 6e-4]), "(500, 600) nm")],
)
def test_lengths_are_printed_in_the_unit_that_suits(value, text):
    assert unchecked("mm").text(value) == text


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


def test_numbers_texts_and_gaps_as_markdown():
    table = Table(("method", "PSNR\ndB", "n"), [("A", 1.26, 3), ("B\nβ", None, "–")], (1,), "All")
    assert str(table).splitlines() == [
        "All",
        "",
        "| method | PSNR dB |   n |",
        "| ------ | ------: | --: |",
        "| A      |     1.3 |   3 |",
        "| B β    |       – |   – |",
    ]


def test_a_row_fits_its_headings_and_fractions_have_digits():
    with pytest.raises(ValueError, match="2 cells under 3 headings"):
        Table(("a", "b", "c"), [("1", "2")])
    with pytest.raises(ValueError, match="0.5 in column 2: give `digits`"):
        str(Table(("a", "b", "c"), [("1", 1.0, 0.5)], (1,)))


SENSOR = tc.Sensor((30, 41), 5.5 * um)
ZONES = tc.FresnelZoneAperture(25.0, width=5.632)
CAMERA = tc.LenslessCamera(ZONES, SENSOR, 6.5)
CELLS = tc.LenslessCamera(tc.SampledMask(np.ones((8, 9)), 30 * um), SENSOR, 6.5)
HOLOGRAM = wg.VolumeHologram(jnp.array([0.0, -15.0, 26e3]), 1.5, 16 * um, 0.02)
SCREEN = wg.Screen(hologram=HOLOGRAM, glass_thickness=5.0, glass_index=1.5)
ONE = jnp.asarray(1.0)
FIT = PsfFit(
    CAMERA,
    *(ONE,) * 4,
    values={"beta": jnp.asarray(25.1), "centre_x": jnp.asarray(3 * um)},
    standard_errors={},
    correlation=jnp.eye(2),
    residual=jnp.ones((3, 4)),
    names=("beta", "centre_x"),
    status="ok",
    reasons=(),
    iterations=1,
)


@pytest.mark.parametrize(
    ("built", "parts"),
    [
        (
            tc.Cameras([CAMERA], wavelength=500 * nm, object_distance=250.0),
            (
                "(beta=25 rad/mm², phase=0 rad, width=5.632 mm, centre=(0, 0) mm, ",
                "distance=6.5 mm",
                "Sensor(shape=(30, 41), pitch=5.5 µm, full_well=13500 electrons)",
                "wavelength=500 nm, object_distance=250 mm",
            ),
        ),
        (CELLS, ("SampledMask(amplitude=f64[8,9], pitch=30 µm",)),
        (
            wg.SeeThroughCamera(
                screen=SCREEN, sensor=SENSOR, focal_distance=6.0, lens_distance=10.0
            ),
            (
                "thickness=16 µm",
                "grating=(0, -15, 26000) rad/mm",
                "glass_thickness=5 mm",
                "focal_distance=6 mm, lens_distance=10 mm",
            ),
        ),
        (tc.GaussianNoise(snr_db=30.0), ("GaussianNoise(snr_db=30 dB, ",)),
        (
            tc.ImagePlane(np.ones((4, 5)), 250.0, 30.0),
            ("ImagePlane(image=f64[4,5], distance=250 mm, width=30 mm)",),
        ),
        (tc.Spectrum([500 * nm, 600 * nm]), ("(wavelengths=(500, 600) nm, weights=(0.5, 0.5))",)),
        (
            Reconstruction(jnp.ones((4, 5)), jnp.asarray(0.04), seconds=1.5),
            ("Reconstruction(image=f64[4,5], pitch=40 µm, seconds=1.5)",),
        ),
        (tc.AdmmTV(tau=2.0), ("AdmmTV(tau=2, ",)),
        (FIT, ("{'beta': 25.1 rad/mm², 'centre_x': 3 µm}", "correlation=f64[2,2]")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_values_have_units(built, parts):
    told = " ".join(repr(built).split()).replace("( ", "(").replace(" )", ")")
    for part in parts:
        assert part in told


def test_what_is_traced_has_no_value():
    seen = []
    jax.jit(lambda camera: seen.append(repr(camera)))(CAMERA)
    for part in (
        "beta=? rad/mm²",
        "centre=(?, ?) mm",
        "shape=(30, 41), pitch=? mm",
        "distance=? mm",
    ):
        assert part in seen[0]
