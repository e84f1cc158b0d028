"""Tables of grey levels and of phases against panels that are known."""

import json

import numpy as np
import pytest
from hardware.displays.rig import Panel, PanelCamera

import thincam_jax as tc
from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.acquisition.acquire import acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.displays.levels import (
    GreyLevels,
    PhaseLevels,
    linear_levels,
    measured_levels,
)
from thincam_jax.hardware.displays.patterns import pattern_levels
from thincam_jax.hardware.plans import grey_levels
from thincam_jax.units import nm, um

SHAPE = 12, 20
ALL = np.arange(256)


def gamma(levels):
    return 60.0 + 3600.0 * (levels / 255.0) ** 2.2


def s_curve_that_falls(levels):
    return 80.0 + 3500.0 * np.cos(np.pi / 2 * levels / 255.0) ** 2


@pytest.mark.parametrize("panel", [gamma, s_curve_that_falls])
def test_a_calibrated_display_is_linear(panel, tmp_path):
    display = Panel(SHAPE)
    camera = PanelCamera(display, panel)
    plan = grey_levels(CameraSettings(exposure=1e-3), frames=2)
    render = lambda pattern: pattern_levels(pattern, SHAPE, 0.0)  # noqa: E731
    with Rig(lambda: camera, lambda: display, render) as rig:
        acquire(plan, rig, tmp_path / "a.zarr")
    levels = measured_levels(Acquisition.load(tmp_path / "a.zarr"))
    assert levels.provenance["camera"]["model"] == "camera" and levels.provenance["frames"] == 2
    display.grey_levels = levels
    seen = []
    for value in ALL:
        display.show(np.full(SHAPE, value, np.uint8))
        seen.append(panel(display.levels().astype(float)).mean())
    low, high = panel(0), panel(255)
    wanted = min(low, high) + abs(high - low) * ALL / 255
    # Half of the coarsest step between levels is what 8 bits allow.
    coarsest = np.abs(np.diff(panel(ALL.astype(float)))).max()
    assert np.abs(seen - wanted).max() < 0.5 * coarsest + 2.0


def test_a_table_is_monotone_whatever_the_noise():
    random = np.random.default_rng(2)
    measured = gamma(ALL) + 100 * random.standard_normal(256)
    table = linear_levels(ALL, measured)
    assert np.all(np.diff(table.table.astype(int)) >= 0)
    assert table.provenance["departure"] > 0.02
    exact = linear_levels(ALL, ALL / 255.0)
    assert np.array_equal(exact.table, ALL)
    assert exact.provenance["nonlinearity"] < 1e-12 and exact.provenance["contrast"] is None


def test_a_file_holds_the_table_and_its_origin(tmp_path):
    path = tmp_path / "levels.json"
    written = linear_levels(ALL, gamma(ALL), {"display": "LC 2012"})
    written.save(path)
    read = GreyLevels.load(path)
    assert np.array_equal(read.table, written.table) and read.provenance == written.provenance
    for content in ({}, [], {"table": [0] * 255, "provenance": {}},
                    {"table": [300] * 256, "provenance": {}},
                    {"table": [0, 2, 1, *[3] * 253], "provenance": {}}):  # fmt: skip
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"levels\.json holds no table"):
            GreyLevels.load(path)


@pytest.mark.parametrize(
    ("levels", "transmission", "message"),
    [
        ([0, 100], [0.0, 1.0], "from 0 to 255"),
        ([0, 255, 254], [0.0, 1.0, 2.0], "ascending"),
        ([0, 255], [0.0, np.nan], "finite"),
        ([0, 255], [1.0, 1.0], "does nothing"),
    ],
)
def test_measurements_that_give_no_table(levels, transmission, message):
    with pytest.raises(ValueError, match=message):
        linear_levels(np.array(levels), np.array(transmission))


LIGHT = 532 * nm
CURVE = tuple(1.8 * np.pi * np.sin(np.pi / 2 * np.arange(18) / 17) ** 2)  # reaches 1.8π
TABLE = PhaseLevels(CURVE, LIGHT)


def apart(first, second):
    return np.abs(np.angle(np.exp(1j * (first - second))))


def test_levels_are_nearest_on_the_circle():
    phase = np.random.default_rng(0).uniform(-20, 20, (7, 11))
    table = np.interp(np.arange(256), np.arange(0, 256, 15), CURVE)
    nearest = apart(table, phase[..., None]).min(axis=-1)
    levels = TABLE.levels(phase, LIGHT)
    assert levels.dtype == np.uint8 and nearest.max() > 0.2  # some lie in the gap to 2π
    np.testing.assert_allclose(apart(table[levels], phase), nearest, atol=1e-7)


def test_phases_at_another_wavelength():
    np.testing.assert_allclose(TABLE.at(633 * nm), TABLE.at(LIGHT) * 532 / 633)
    phase = np.full((2, 3), 4.0)
    assert (TABLE.levels(phase, 633 * nm) > TABLE.levels(phase, LIGHT)).all()


def test_a_gap_in_the_phases_is_refused_and_the_advice_holds():
    phase = np.linspace(0, 2 * np.pi, 40).reshape(4, 10)
    with pytest.raises(
        ValueError, match=r"the phase 5\.48 rad is 0\.73 rad from .*0\.39"
    ) as caught:
        TABLE.levels(phase, 633 * nm)
    asked = float(str(caught.value).partition("a tolerance of ")[2].partition(" rad")[0])
    wider = PhaseLevels(CURVE, LIGHT, tolerance=asked)
    assert wider.levels(phase, 633 * nm).shape == phase.shape
    below = phase * 4.7 / phase.max()
    assert TABLE.levels(below, 633 * nm).shape == phase.shape


def test_a_lens_and_its_mask():
    lens = tc.LensletArray(focal_length=40.0, pitch=0.48)
    levels = TABLE.levels_of(lens, 20 * um, LIGHT)
    place = (np.arange(24) - 11.5) * 0.02
    wanted = -np.pi * (place[:, None] ** 2 + place**2) / (LIGHT * 40.0)
    shown = TABLE.mask(levels, 20 * um, LIGHT, 0.9)
    assert apart(np.angle(np.asarray(shown.amplitude)), wanted).max() < np.pi / 8
    assert shown.finest_frequency is None
    np.testing.assert_allclose(np.asarray(shown.fill_factor), 0.9)
    for mask, line in ((tc.FresnelZoneAperture(25.0, width=0.48), "it turns no phase"),
                       (tc.LensletArray(40.0, 0.47), "not a whole number of cells")):  # fmt: skip
        with pytest.raises(ValueError, match=line):
            TABLE.levels_of(mask, 20 * um, LIGHT)


def test_a_file_holds_the_table(tmp_path):
    path = tmp_path / "slm.json"
    table = PhaseLevels(CURVE, LIGHT, 0.5, gap=0.2)
    table.save(path)
    assert PhaseLevels.load(path) == table
    for content in ({}, [], {"phases": [0.0], "wavelength": LIGHT},
                    {"phases": ["a", "b"], "wavelength": LIGHT},
                    {"phases": [0.0, 1.0], "wavelength": LIGHT, "gap": 2.0}):  # fmt: skip
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"slm\.json holds no table of phases"):
            PhaseLevels.load(path)
    with pytest.raises(ValueError, match=r"none\.json holds no table of phases: .*No such file"):
        PhaseLevels.load("none.json")
