"""Whatever a device does wrong, no wrong, stale or repeated frame is in the store."""

import copy
import itertools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hardware.acquisition.fault_campaign import STOPS, campaign, require_right
from hardware.memory_rig import World, by_rows, fiducial_plan, picture_plan, scene_plan, staying

from helpers import ROOT, quick
from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.base import IncompleteFrame, ProtocolError
from thincam_jax.hardware.virtual.devices import FAULTS

PROCESS = [sys.executable, ROOT / "tests" / "hardware" / "memory_rig.py"]
PATHS = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
ENVIRONMENT = {**os.environ, "PYTHONPATH": PATHS}


@pytest.mark.parametrize("times", [3, pytest.param(100, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_recovered_from_or_stops_the_run(fault, times, tmp_path):
    row = campaign(fault, times, tmp_path)
    expected = (0, times) if fault in STOPS else (times, 0)
    assert (row.injected, row.recovered, row.stopped) == (times, *expected)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["pictures", "scene"])
@pytest.mark.parametrize("fault", FAULTS)
def test_of_pictures_and_of_bracketed_scenes_too(fault, kind, tmp_path):
    """With repeats, dark frames, and for the scene an exposure that is found."""
    row = campaign(fault, 6, tmp_path, kind)
    expected = (0, 6) if fault in STOPS else (6, 0)
    assert (row.injected, row.recovered, row.stopped) == (6, *expected)


def altered(frame, **parts):
    """The frame with other parts, unchecked as those of a driver are."""
    made = copy.copy(frame)
    for name, part in parts.items():
        object.__setattr__(made, name, part)
    return made


WRONG = {
    "no frame": lambda frame: None,
    "an array": lambda frame: frame.pixels,
    "lists": lambda frame: altered(frame, pixels=[[1]]),
    "no number": lambda frame: altered(frame, number=None),
    "negative": lambda frame: altered(frame, pixels=frame.pixels.astype(np.int32) - 4000),
    "half counts": lambda frame: altered(frame, pixels=frame.pixels + 0.5),
    "NaN": lambda frame: altered(frame, pixels=frame.pixels * np.nan),
    "too few bits": lambda frame: altered(frame, pixels=frame.pixels.astype(np.uint8)),
    "no bits": lambda frame: altered(frame, bit_depth=0),
    "bits below 0": lambda frame: altered(frame, bit_depth=-1),
    "no time": lambda frame: altered(frame, time=np.nan),
    "wide": lambda frame: altered(frame, pixels=np.tile(frame.pixels, (1, 2))),
    "cut": lambda frame: altered(frame, pixels=frame.pixels[1:]),
    "transposed": lambda frame: altered(frame, pixels=frame.pixels.T),
    "coloured": lambda frame: altered(frame, pixels=np.stack([frame.pixels] * 3, -1)),
    "another exposure": lambda frame: altered(frame, exposure=0.02),
    "an old number": lambda frame: altered(frame, number=0),
}


@pytest.mark.parametrize("first", quick([2, 5], 1))
@pytest.mark.parametrize("wrong", WRONG)
def test_a_frame_that_is_none_is_not_kept(wrong, first, tmp_path):
    """Of a driver that breaks its contract from some frame on; a sound one goes on from there."""
    world, plan = World(), fiducial_plan(8)
    with world.rig() as rig:
        camera = rig.camera
        sound, count = camera.trigger_and_grab, itertools.count(1)

        def grab(timeout):
            frame = sound(timeout)
            return frame if next(count) < first else WRONG[wrong](frame)

        camera.trigger_and_grab = grab
        with pytest.raises((ProtocolError, IncompleteFrame)) as told:
            acquire(plan, rig, tmp_path / "store", procedure=Procedure(reopen_wait=0.0))
        assert "\n" not in str(told.value) and len(str(told.value)) < 250
    with pytest.raises(CaptureStoreError, match=f"{10 - first} of 8 frames are missing"):
        Acquisition.load(tmp_path / "store")
    with world.rig() as rig:
        assert acquire(plan, rig, tmp_path / "store").complete
    require_right(tmp_path / "store", plan)


def frames_in(store):
    journal = store / "journal.jsonl"
    return journal.read_bytes().count(b'"step":') if journal.exists() else 0


@pytest.mark.parametrize(
    ("kills", "count", "kept"),
    [
        (1, 40, ""),
        pytest.param(20, 500, "", marks=pytest.mark.thorough),
        pytest.param(10, 512, "rows", marks=pytest.mark.thorough),
        pytest.param(6, 240, "pictures", marks=pytest.mark.thorough),
        pytest.param(6, 240, "scene", marks=pytest.mark.thorough),
    ],
)
def test_a_killed_run_is_resumed(kills, count, kept, tmp_path):
    """A kill at the start may find no store, one while it runs finds frames half written."""
    store, random = tmp_path / "store", np.random.default_rng(4)
    plan = fiducial_plan(count, dark_every=16)
    kinds = {
        "rows": lambda: by_rows(plan), "pictures": lambda: picture_plan(count),
        "scene": lambda: scene_plan(count)
    }  # fmt: skip
    plan = kinds[kept]() if kept else plan
    for kill in range(kills):
        before = frames_in(store)
        process = subprocess.Popen(
            [*PROCESS, store, str(count), kept], env=ENVIRONMENT, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )  # fmt: skip
        with process:
            if kill % 5 == 4:
                time.sleep(random.uniform(0.0, 0.4))  # before the first frame
            else:
                frames = before + random.integers(1, 1 + count // (2 * kills))
                while process.poll() is None and frames_in(store) < frames:
                    time.sleep(0.001)
                time.sleep(random.uniform(0.0, 0.01))
            assert process.poll() is None, process.communicate()
            process.send_signal(signal.SIGKILL)
    with World().rig() as rig:
        assert acquire(plan, rig, store).complete
    require_right(store, plan)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.thorough
@pytest.mark.parametrize("done", quick([3, 9], 1))  # before and after the first given position
def test_a_stage_that_stays_is_moved_back_by_a_new_process(done, tmp_path):
    """The resumed process finds the stage homed, at 0, and not where the last step left it."""
    world, plan = World(), staying(fiducial_plan(12, dark_every=16))
    world.position = 3.0
    with world.rig() as rig:
        stop = lambda now: now.done == done and os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
        assert not acquire(plan, rig, tmp_path / "store", progress=stop).complete
    subprocess.run([*PROCESS, tmp_path / "store", "12", "stays"], env=ENVIRONMENT, check=True)
    shots = Acquisition.load(tmp_path / "store").shots
    assert [shot["position"] for shot in shots] == [3.0] * 6 + [1.0] * 5 + [2.0] * 2


def test_sigterm_stops_between_two_frames(tmp_path):
    done = []
    plan = fiducial_plan(9)
    with World().rig() as rig:
        for most in (4, 99):
            run = acquire(
                plan, rig, tmp_path / "store",
                progress=lambda now, most=most: (
                    done.append(now.done), now.done == most and os.kill(os.getpid(), 15)
                ),
            )  # fmt: skip
    assert run.complete and done == list(range(1, 10))
    require_right(tmp_path / "store", plan)
