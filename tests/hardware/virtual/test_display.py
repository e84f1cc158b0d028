"""The virtual panel: what it hands over, its response and its faults."""

import numpy as np
import pytest
from hardware.displays.rig import Clock

from thincam_jax.hardware import OutOfRange
from thincam_jax.hardware.displays.grey_levels import GreyLevels
from thincam_jax.hardware.virtual import display as module
from thincam_jax.hardware.virtual.display import VirtualDisplay
from thincam_jax.hardware.virtual.faults import Faults

SHAPE = 3, 5
WHITE = np.full(SHAPE, 255, np.uint8)


def test_patterns_are_handed_over_through_the_table():
    shown, table = [], GreyLevels(np.arange(255, -1, -1).astype(np.uint8), {})
    with VirtualDisplay(SHAPE, shown.append, grey_levels=table) as display:
        pattern = np.arange(15, dtype=np.uint8).reshape(SHAPE)
        display.show(pattern)
        assert np.array_equal(shown[0], 255 - pattern)
        assert np.array_equal(display.levels(), 255.0 - pattern)
        with pytest.raises(OutOfRange):
            display.show(pattern.T)
    assert len(shown) == 1


def test_the_panel_follows_exponentially_also_where_it_is_changed_on_the_way(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    display = VirtualDisplay(SHAPE, response=0.01)
    display.show(WHITE)
    assert np.all(display.levels() == 0.0)
    clock.sleep(0.02)
    half_way = display.levels()[0, 0]
    assert half_way == pytest.approx(255 * (1 - np.exp(-2)), rel=1e-6)
    display.show(~WHITE)
    clock.sleep(0.005)
    assert display.levels()[0, 0] == pytest.approx(half_way * np.exp(-0.5), rel=1e-6)


def test_a_late_show(monkeypatch):
    clock, faults = Clock(), Faults()
    monkeypatch.setattr(module, "time", clock)
    display = VirtualDisplay(SHAPE, faults=faults)
    faults.inject("latency")
    display.show(WHITE)
    assert clock.now > 0 and faults.happened["latency"] == 1
    before = clock.now
    display.show(WHITE)
    assert clock.now == before
