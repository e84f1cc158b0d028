"""The settle time of panels that follow exponentially: τ·ln(1/tolerance)."""

import numpy as np
import pytest
from hardware.displays.rig import Clock, Panel, PanelCamera

from thincam_jax.hardware.base import OutOfRange, Timeout
from thincam_jax.hardware.displays import settle
from thincam_jax.hardware.displays.settle import settle_calibrate

SHAPE = 12, 20
RESPONSE, LONGEST = 0.02, 0.2  # s


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(settle, "time", clock)
    return clock


def linear(levels):
    return 100.0 + 14.0 * levels


@pytest.mark.parametrize("tolerance", [0.05, 0.01])
def test_it_is_found(tolerance, clock):
    display = Panel(SHAPE, RESPONSE, clock)
    camera = PanelCamera(display, linear)
    found = settle_calibrate(display, camera, tolerance=tolerance, longest=LONGEST)
    expected = RESPONSE * np.log(1 / tolerance)
    assert expected <= found < expected + LONGEST / 8


def test_patterns_of_ones_own_and_a_panel_without_inertia():
    random = np.random.default_rng(4)
    patterns = tuple(random.integers(0, 256, (2, *SHAPE), dtype=np.uint8))
    display = Panel(SHAPE)
    camera = PanelCamera(display, linear)
    found = settle_calibrate(display, camera, (patterns[0], patterns[1]), longest=LONGEST)
    assert found == 0.0


@pytest.mark.parametrize(
    ("counts", "longest", "error", "message"),
    [
        (linear, 0.04, Timeout, "raise longest"),
        (lambda levels: 100.0 + 0.05 * levels, LONGEST, OutOfRange, "expose longer"),
    ],
)
def test_what_cannot_be_found(clock, counts, longest, error, message):
    display = Panel(SHAPE, RESPONSE, clock)
    with pytest.raises(error, match=message):
        settle_calibrate(display, PanelCamera(display, counts), longest=longest)


def test_a_camera_that_does_not_see_the_display(clock):
    display = Panel(SHAPE, RESPONSE, clock)
    camera = PanelCamera(display, lambda levels: np.full(SHAPE, 100.0), noise=0.0)
    with pytest.raises(OutOfRange, match="both patterns give the same frame"):
        settle_calibrate(display, camera, longest=LONGEST)
