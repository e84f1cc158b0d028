"""A camera that is covered by hand for its dark frames."""

import shutil
import signal

import numpy as np
import pytest
from hardware.memory_rig import SETTINGS, MemoryCamera, World

from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.plan import WHITE
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.displays.patterns import pattern_levels
from thincam_jax.hardware.displays.settle import Shutter
from thincam_jax.hardware.plans import scene
from thincam_jax.hardware.registry import open_device
from thincam_jax.hardware.virtual.devices import VirtualDisplay


@pytest.fixture
def rig(monkeypatch):
    """A rig without a display, and what its user was asked."""
    world, asked = World(), []
    world.shown = np.ones(world.shape, np.uint8)

    def cover(text):
        asked.append(text.partition(",")[0])
        world.shown = np.full(world.shape, "uncover" in text, np.uint8)

    monkeypatch.setattr("builtins.input", cover)
    render = lambda pattern: pattern_levels(pattern, (1, 1), 0.0)  # noqa: E731
    with Rig(
        lambda: world.open(MemoryCamera), lambda: open_device("displays", "shutter"), render
    ) as rig:
        yield rig, asked


def test_it_is_asked_for_once(rig, tmp_path):
    plan = scene(WHITE, SETTINGS, exposures=(0.01, 0.05), frames=2, dark_frames=2)
    procedure = Procedure(settle=None, exposure="auto")
    acquire(plan, rig[0], tmp_path / "a.zarr", procedure=procedure)
    assert rig[1] == ["cover the camera"]
    taken = Acquisition.load(tmp_path / "a.zarr")
    assert taken.frame(3).max() == 4095  # the longer one may be full
    frame, variance = taken.scene()
    assert frame.shape == (1, *taken.sensor_shape) and np.isfinite(variance).all()
    ratio = taken.settings[1].exposure / taken.settings[0].exposure
    assert ratio == pytest.approx(5, rel=1e-2)


def test_a_resumed_run_does_not_take_the_camera_for_open(rig, tmp_path):
    """It was covered for dark frames when the run before, whose last frames are lost, ended."""
    plan = scene(WHITE, SETTINGS, frames=3, dark_frames=2)
    stop = lambda now: now.done == 4 and signal.raise_signal(signal.SIGTERM)  # noqa: E731
    store = tmp_path / "a.zarr"
    assert not acquire(plan, rig[0], store, progress=stop).complete
    shutil.rmtree(store / "frames" / "c" / "2")
    rig[0].reopen("display")  # as in another process
    assert acquire(plan, rig[0], store).complete
    assert rig[1] == ["cover the camera", "uncover the camera", "cover the camera"]
    taken = Acquisition.load(store)
    np.testing.assert_array_equal(taken.frame(2), taken.frame(0))


def test_before_a_phase_modulator_it_passes_all_but_black_on(monkeypatch):
    """On which no pattern is dark: a dark frame is one with the camera covered."""
    shown, asked = [], []
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text.partition(",")[0]))
    display = VirtualDisplay((2, 3), shown.append)
    shutter = Shutter(Shutter.Options(), display)
    assert shutter.shape == (2, 3) and shutter.identity == display.identity
    for level in (7, 0, 0, 9):
        shutter.show(np.full((2, 3), level, np.uint8))
    assert [levels.max() for levels in shown] == [7, 9]
    assert asked == ["cover the camera", "uncover the camera"]
