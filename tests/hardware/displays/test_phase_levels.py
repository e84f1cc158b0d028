"""Levels of a phase modulator against phases that are known."""

import json

import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.hardware.displays.levels import PhaseLevels
from thincam_jax.units import nm, um

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
