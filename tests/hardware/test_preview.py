"""The preview of a rig: what is set, what a frame tells, what is kept, devices that fail."""

import io
import json

import numpy as np
import PIL.Image
import pytest
import tifffile
from hardware.memory_rig import SETTINGS, World, fiducial_plan

from thincam_jax.hardware.acquisition.taker import Procedure
from thincam_jax.hardware.base import Frame
from thincam_jax.hardware.preview import FrameNumbers, Preview

SHAPE = 24, 36
TEXTURE = np.random.default_rng(0).integers(100, 3000, SHAPE).astype(np.uint16)


@pytest.fixture
def world():
    return World(SHAPE, TEXTURE)


def shown(view, name="frame"):
    return np.asarray(PIL.Image.open(io.BytesIO(view.pictures[name])), float)


def test_a_frame_is_shown_on_its_scale_with_full_pixels_in_red(world):
    with world.rig(stage=False) as rig:
        preview = Preview(rig, fiducial_plan(1, stage=False), image=lambda frame: frame / 4095)
        view = preview.view()
        picture = shown(view)
        lit = np.ones(SHAPE, bool)
        lit[SHAPE[0] // 2], lit[:, SHAPE[1] // 2] = False, False  # the cross
        expected = world.see(SETTINGS.exposure) * (255 / 4095)
        assert np.abs(picture.mean(axis=-1) - expected)[lit].mean() < 6  # of a JPEG
        assert np.abs(shown(view, "image") - expected).mean() < 6
        world.light = 100.0
        bright = preview.view()
        assert "100% of full scale" in bright.lines[0]
        red, green, blue = np.moveaxis(shown(bright), -1, 0)
        assert red.mean() > 200 and max(green.mean(), blue.mean()) < 80


def test_what_examination_finds_is_told_of_each_setting(world):
    """A hot pixel and saturation; not again until a control is turned."""
    y, x = np.indices(SHAPE)
    world.texture = (1000 + 40 * y + 20 * x).astype(np.uint16)
    world.texture[12, 20] = 4000
    with world.rig(stage=False) as rig:
        preview = Preview(rig, fiducial_plan(1, stage=False))
        (hot,) = preview.view().lines[3:]
        assert hot.startswith("capture frame: 1 hot or dead pixels are not used")
        world.light = 2.5
        assert preview.view().lines[3:] == (hot,)
        preview.turn({"gain": 1.0})
        assert "saturated" in " ".join(preview.view().lines[3:])


def test_numbers_of_a_frame():
    """Blur lowers the focus, light does not change it; the histogram is over the full scale."""
    sharp = np.zeros(SHAPE, np.uint16) + 400
    sharp[6:18, 9:27] = 2000
    blurred = (sharp + np.roll(sharp, 1, 0) + np.roll(sharp, 1, 1) + np.roll(sharp, -1, 1)) // 4

    def numbers(pixels):
        return FrameNumbers.of(Frame(pixels.astype(np.uint16), 1, 0.0, 0.01, 12))

    assert numbers(blurred).focus < 0.7 * numbers(sharp).focus
    assert numbers(sharp // 2).focus == pytest.approx(numbers(sharp).focus, rel=1e-3)
    found = numbers(sharp)
    assert np.flatnonzero(found.histogram).tolist() == [400 * 64 // 4096, 2000 * 64 // 4096]
    assert found.brightest == pytest.approx(2000 / 4095, rel=1e-6) and found.saturated == 0


def test_a_kept_frame_has_its_counts_and_where_they_come_from(world, tmp_path):
    with world.rig() as rig:
        preview = Preview(rig, fiducial_plan(2), folder=tmp_path / "kept")
        preview.turn({"pattern": 1.0})
        view = preview.view(rest=True)
        (path,) = (tmp_path / "kept").iterdir()
        assert view.lines[-1] == f"Kept as {path}."
        with tifffile.TiffFile(path) as file:
            known = json.loads(file.pages[0].description)
            np.testing.assert_array_equal(file.asarray(), world.see(SETTINGS.exposure))
        assert known["settings"]["exposure"] == SETTINGS.exposure
        assert known["devices"]["camera"].startswith("thincam_jax memory camera")
        assert known["position_mm"] == 0.0


@pytest.mark.parametrize(
    ("fault", "role"),
    [("dropped_frame", "camera"), ("nak", "camera"), ("unplug", "camera"), ("unplug", "display")],
)
def test_a_device_that_fails_is_told_of_and_used_again(world, fault, role):
    procedure = Procedure(timeout=0.001, reopen_wait=0.0)
    with world.rig(stage=False) as rig:
        preview = Preview(rig, fiducial_plan(2, stage=False), procedure)
        preview.view()
        world.unplugs = role
        world.faults.inject(fault)
        preview.turn({"exposure": 11.0, "pattern": 1.0})
        (line,) = preview.view().lines
        assert line.startswith(f"{role}: ")
        assert "frame" in preview.view().pictures
        assert world.opened[role] == (2 if fault == "unplug" else 1)


def test_controls_set_the_devices_and_only_when_they_are_turned(world):
    with world.rig() as rig:
        world.position = 7.5
        preview = Preview(rig, fiducial_plan(3))
        assert [one.name for one in preview.controls] == [
            *("exposure", "gain", "pattern", "position")
        ]
        assert preview.view().values["exposure"] == pytest.approx(1000 * SETTINGS.exposure)
        assert world.position == 7.5  # looking does not move the stage
        preview.turn({"exposure": 20.0, "pattern": 2.0, "position": 12.0})
        view = preview.view()
        assert rig.camera.settings.exposure == pytest.approx(0.02)
        assert (world.position, world.shown[0, 0]) == (12.0, 3)
        header, pictures = view.message()
        assert json.loads(header)["values"]["position"] == 12.0 and len(pictures) == 1
        with pytest.raises(ValueError, match="control"):
            preview.turn({"focus": 1.0})
        with pytest.raises(ValueError, match="exposure"):
            preview.turn({"exposure": 1e6})
