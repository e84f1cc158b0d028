"""The table of grey levels against panels whose transmission is known."""

import json

import numpy as np
import pytest
from hardware.displays.rig import Panel, PanelCamera

from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.acquisition.acquire import acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.displays.levels import GreyLevels, linear_levels, measured_levels
from thincam_jax.hardware.displays.patterns import pattern_levels
from thincam_jax.hardware.plans import grey_levels

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
