"""An acquisition takes the frames of its plan, and no others, whatever goes wrong."""

import dataclasses
import errno
import os
import signal
import time
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest
from hardware.displays.rig import Clock, Panel, PanelCamera
from hardware.memory_rig import (
    SETTINGS,
    SHAPE,
    MemoryCamera,
    MemoryDisplay,
    MemoryStage,
    World,
    fiducial,
    fiducial_plan,
)

from thincam_jax._core.capture_store import CaptureStore, CaptureStoreError
from thincam_jax._core.files import WriteError
from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.acquisition import recorder, taker
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.base import (
    Disconnected,
    Frame,
    IncompleteFrame,
    NotFound,
    NotHomed,
    OutOfRange,
    ProtocolError,
    Region,
    Saturated,
    Timeout,
)
from thincam_jax.hardware.displays import settle
from thincam_jax.hardware.plans import hadamard, pictures
from thincam_jax.measured.calibration import HadamardCaptures, HadamardSeries, recover_matrix

QUICK = Procedure(timeout=0.001, reopen_wait=0.0)
PLAN = fiducial_plan(20, dark_every=8)


def run(world, path, plan=PLAN, procedure=QUICK, progress=None):
    with world.rig() as rig:
        return acquire(plan, rig, path, procedure=procedure, progress=progress)


def stop_after(count):
    """A progress callback that stands for Ctrl-C after so many frames."""
    return lambda now: signal.raise_signal(signal.SIGINT) if now.done == count else None


def require_whole(path, plan=PLAN):
    taken = Acquisition.load(path)
    shown = [fiducial(taken.frame(number)) for number in range(len(plan.steps))]
    assert shown == [-1 if step.dark else step.pattern for step in plan.steps]
    return taken


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.zarr"


def test_every_step_has_its_frame(path):
    heard = []
    done = run(World(), path, progress=heard.append)
    assert done.complete and not done.recovered
    assert set(done.seconds) == {"move", "show", "flush", "trigger", "check", "keep"}
    assert [now.done for now in heard] == list(range(1, 24))
    taken = require_whole(path)
    assert taken.plan == PLAN and taken.bits == 12 and taken.sensor_shape == SHAPE
    assert taken.captures().shape == (20, *SHAPE) and taken.dark().shape == SHAPE
    assert taken.distances[:7] == [0, 0, 0, 0, 0, 1, 1]
    assert taken.settings[0].exposure == SETTINGS.exposure
    assert taken.settings[0].region.width == SHAPE[1]  # what the camera took, not what was asked
    assert taken.provenance["devices"]["camera"]["serial"] == "1"
    assert taken.provenance["versions"]["zarr"]


@pytest.mark.parametrize("dark", [0, 3, 20])
def test_a_hadamard_plan_is_read_as_a_calibration(path, dark):
    series = HadamardSeries((4, 4), "sequency", "binary", dark_frames=dark)
    plan, world = hadamard(series, SETTINGS), World()
    matrix = np.random.default_rng(0).integers(0, 200, (54, 16))

    def render(pattern):
        cells = series.frame(int(pattern.numbers.get("frame", series.frame_count - 1)))
        return cells if pattern.kind == "hadamard" else 0 * cells

    world.see = lambda exposure: (matrix @ world.shown.ravel() + 7).reshape(SHAPE).astype("u2")
    world.render = render
    assert run(world, path, plan, progress=stop_after(11)).done == 11
    for reader in (HadamardCaptures.load, HadamardCaptures.resume):
        with pytest.raises(CaptureStoreError, match="the same acquisition again"):
            reader(path)
    assert run(world, path, plan).complete
    captures = HadamardCaptures.load(path)
    assert captures.series == series and captures.bits == 12
    assert captures.exposure == SETTINGS.exposure
    if dark:
        # Dark frames lie among the patterns, and are the last ones of the series.
        assert dark > 3 or captures.stored_at[-3:] == (0, 7, 14)
        np.testing.assert_array_equal(captures.rows(0, 6)[16:], 7)
        np.testing.assert_allclose(recover_matrix(captures).matrix, matrix, atol=1e-3)


@pytest.fixture
def ctrl_c():
    """Ctrl-C interrupts, also where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_a_stopped_run_is_resumed(path, ctrl_c):
    world = World()
    assert run(world, path, progress=stop_after(6)).done == 6
    assert signal.getsignal(signal.SIGINT) is ctrl_c
    with pytest.raises(CaptureStoreError, match="17 of 23 frames are missing: 6, 7, 8"):
        Acquisition.load(path)
    assert run(world, path).complete
    require_whole(path)
    assert run(world, path).complete  # there is nothing left to do
    with pytest.raises(KeyboardInterrupt):
        run(world, path.with_name("b.zarr"), progress=lambda now: [
            signal.raise_signal(signal.SIGINT) for _ in range(2)
        ])  # fmt: skip
    assert run(world, path.with_name("b.zarr")).complete
    require_whole(path.with_name("b.zarr"))


def test_only_the_same_run_is_resumed(path, monkeypatch):
    run(World(), path, progress=stop_after(6))
    with pytest.raises(
        CaptureStoreError, match="was begun with another plan .*; give another name"
    ):
        run(World(), path, fiducial_plan(21, dark_every=8))
    with World().rig(stage=False) as rig, pytest.raises(ValueError, match="the rig has none"):
        acquire(PLAN, rig, path)
    other = World()
    other.serial = "2"
    with pytest.raises(CaptureStoreError, match=r"begun with the camera .*\(1\), and .*\(2\)"):
        run(other, path)
    taken = MemoryCamera.configure
    with monkeypatch.context() as changed:
        changed.setattr(
            MemoryCamera,
            "configure",
            lambda self, settings: dataclasses.replace(taken(self, settings), exposure=0.011),
        )
        with pytest.raises(ProtocolError, match="in place of .*; undo what has changed"):
            run(World(), path)
    (path / "plan.json").write_text("{}", "utf-8")
    with pytest.raises(CaptureStoreError, match="not what an acquisition made"):
        Acquisition.load(path)


def test_two_runs_cannot_write_one_store(path):
    def second(_):
        with pytest.raises(CaptureStoreError, match="is being written by another run; wait"):
            run(World(), path)

    run(World(), path, progress=second)
    require_whole(path)


def test_room_is_needed_first(path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    with monkeypatch.context() as full:
        full.setattr(recorder.shutil, "disk_usage", lambda _: usage(0, 0, 2483))
        with pytest.raises(CaptureStoreError, match="needs 2.48e-06 GB more and 2.48e-06 GB are"):
            run(World(), path)
    run(World(), path)
    require_whole(path)


def test_a_torn_line_and_a_lost_chunk_are_taken_again(path):
    run(World(), path)
    journal = path / "journal.jsonl"
    whole = journal.read_bytes()
    for torn in (whole[:-1], whole[:-9], whole[:-9] + b"\0" * 9, whole[:-9] + b"\0" * 8 + b"\n"):
        journal.write_bytes(torn)
        with pytest.raises(CaptureStoreError, match="of 23 frames are missing: .*; run"):
            Acquisition.load(path)
        assert run(World(), path).done == 23
        require_whole(path)
    chunk = path / "frames" / "c" / "7" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-9])
    (path / "frames" / "c" / "9" / "0" / "0").unlink()
    with pytest.raises(CaptureStoreError, match="2 of 23 frames are missing: 7, 9"):
        Acquisition.load(path)
    assert run(World(), path).complete
    taken = require_whole(path)
    chunk.write_bytes((path / "frames" / "c" / "8" / "0" / "0").read_bytes())
    with pytest.raises(CaptureStoreError, match="frame 7 is not the one that was taken"):
        taken.frame(7)
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join([lines[0], lines[1].replace(b"0", b"1"), *lines[2:]]))
    with pytest.raises(CaptureStoreError, match="line 2 is damaged, and it is not the last"):
        run(World(), path)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda world: setattr(world, "light", 9.0), Saturated),
        (lambda world: setattr(world, "limits", (0.0, 0.5)), OutOfRange),
        (lambda world: setattr(world, "homed", False), NotHomed),
        (lambda world: world.faults.inject("nak"), ProtocolError),
    ],
)
def test_what_does_not_pass_is_not_tried_again(path, change, error):
    world, calls = World(), []
    run(world, path, progress=stop_after(5))
    change(world)
    with pytest.raises(error):
        run(world, path, progress=calls.append)
    assert len(calls) < 3
    assert run(World(), path).complete
    require_whole(path)


def test_a_device_that_has_gone_is_opened_again(path):
    for role in ("camera", "display", "stage"):
        world = World()
        world.unplugs, world.absent = role, 2
        store = path.with_name(role)
        done = run(world, store, progress=after_nine(world))
        assert done.complete and done.recovered[0].startswith("Disconnected: ")
        assert world.opened == {**dict.fromkeys(world.opened, 1), role: 2}
        require_whole(store)
    world = World()
    world.absent = 9
    with pytest.raises(Disconnected) as stopped:
        run(world, path, progress=after_nine(world))
    assert isinstance(stopped.value.__cause__, NotFound)

    world = World()
    pull = after_nine(world)
    with pytest.raises(NotFound, match=r"\(2\) is there in its place; connect"):
        run(
            world,
            path.with_name("b"),
            progress=lambda now: [pull(now), vars(world).update(serial="2")],
        )


def after_nine(world):
    """A progress callback that pulls the plug."""
    return lambda now: world.faults.inject("unplug") if now.done == 9 else None


def test_the_same_capture_twice_is_refused(path, monkeypatch):
    """A driver that gives an old buffer a new number."""
    world, taken = World(), MemoryCamera.trigger_and_grab
    times = iter([0, 0, 0, 0, 1, 0] + [1] * 99)

    def old(self, timeout):
        last, frame = self.last, taken(self, timeout)
        if next(times):
            self.last = Frame(last.pixels, frame.number, frame.time, frame.exposure, 12)
        return self.last

    monkeypatch.setattr(MemoryCamera, "trigger_and_grab", old)
    with pytest.raises(IncompleteFrame, match="that of the pattern before, digit for digit"):
        run(world, path)
    monkeypatch.undo()
    assert run(world, path).complete
    require_whole(path)


def test_the_exposure_is_found_once(path):
    procedure = dataclasses.replace(QUICK, exposure="auto")
    world = World()
    world.light = 40.0
    run(world, path, procedure=procedure, progress=stop_after(4))
    world.light = 45.0  # the exposure that was found is kept
    found = run(world, path, procedure=procedure).found
    taken = Acquisition.load(path)
    assert found == (f"exposure {1000 * taken.settings[0].exposure:.4g} ms",)
    assert 1e-5 < taken.settings[0].exposure < 0.001
    assert np.quantile(taken.frame(1), 0.999) / 4095 == pytest.approx(0.7, rel=0.1)
    for light, error in ((1e-3, OutOfRange), (1e9, Saturated)):
        world.light = light
        with pytest.raises(error, match="find the exposure: level .*0.7 wanted; change the light"):
            run(world, path.with_name("b"), procedure=procedure)
    world.light = 10.0
    longer = dataclasses.replace(SETTINGS, exposure=3 * SETTINGS.exposure)
    run(
        world,
        path.with_name("c"),
        dataclasses.replace(PLAN, settings=(SETTINGS, longer)),
        procedure,
    )
    first, second = Acquisition.load(path.with_name("c")).settings
    assert first.exposure < 0.003
    assert second.exposure == pytest.approx(3 * first.exposure, rel=1e-3)


def test_the_settle_time_is_measured_once(path, monkeypatch):
    """Of a panel that follows exponentially: τ·ln(1/tolerance); a resumed run keeps it."""
    clock = Clock()
    for module in (settle, taker):
        monkeypatch.setattr(module, "time", clock)
    display = Panel(SHAPE, 0.02, clock)
    camera = PanelCamera(display, lambda levels: 100.0 + 14.0 * levels)
    levels = {"a": np.full(SHAPE, 200, np.uint8), "b": np.full(SHAPE, 90, np.uint8)}
    plan = pictures(levels, CameraSettings(exposure=1e-3), frames=2)
    procedure = dataclasses.replace(QUICK, settle=None)

    def begin(progress=None):
        render = lambda pattern: levels.get(pattern.label, np.zeros(SHAPE, np.uint8))  # noqa: E731
        with Rig(lambda: camera, lambda: display, render) as rig:
            return acquire(plan, rig, path, procedure=procedure, progress=progress)

    assert not begin(stop_after(1)).complete
    found = begin().found
    known = Acquisition.load(path).provenance["procedure"]["settle"]
    assert 0.02 * np.log(100) <= known < 0.02 * np.log(100) + 0.5 / 8
    assert found == (f"settle time {1000 * known:.3g} ms",)
    assert abs(Acquisition.load(path).frame(2).mean() - (100 + 14 * 90)) < 0.015 * 14 * 110


def test_a_full_disk_stops_the_run(path, monkeypatch):
    def full(self, images):
        raise OSError(errno.ENOSPC, "No space left on device")

    world = World()
    run(world, path, progress=stop_after(4))
    with monkeypatch.context() as disk, pytest.raises(WriteError, match="cannot be written .No sp"):
        disk.setattr(CaptureStore, "write", full)
        run(world, path)
    assert run(world, path).complete
    require_whole(path)
    (path.parent / "file").touch()
    with pytest.raises(WriteError, match="cannot be written"):
        run(world, path.parent / "file" / "a.zarr")
    with pytest.raises(CaptureStoreError, match="is no store of captures"):
        run(world, path.parent / "file")


class LateCamera(MemoryCamera):
    """Its frames wait in a queue; that of the fifth trigger comes when nobody waits for it."""

    def __init__(self, world):
        super().__init__(world)
        self.queue = []

    def flush(self):
        self.queue = [(ready, frame) for ready, frame in self.queue if ready > time.monotonic()]

    def trigger_and_grab(self, timeout):
        frame = super().trigger_and_grab(timeout)
        late = 1.5 * timeout if frame.number == 5 else 0.0
        self.queue.append((time.monotonic() + late, frame))
        if late:
            time.sleep(timeout)
            raise Timeout("camera", "trigger", "no frame", "wait longer")
        return self.queue.pop(0)[1]


def test_a_frame_that_comes_too_late_is_no_other_steps_frame(path):
    world = World()
    with Rig(
        lambda: LateCamera(world), lambda: MemoryDisplay(world), world.render,
        lambda: MemoryStage(world)
    ) as rig:  # fmt: skip
        done = acquire(PLAN, rig, path, procedure=Procedure(timeout=0.02))
    assert len(done.recovered) == 1
    require_whole(path)


def test_frames_of_a_store_have_one_shape(path):
    regions = [SETTINGS, dataclasses.replace(SETTINGS, region=Region(1, 2, 4, 5))]
    steps = [dataclasses.replace(step, settings=n % 2) for n, step in enumerate(PLAN.steps)]
    plan = dataclasses.replace(PLAN, settings=tuple(regions), steps=tuple(steps))
    with pytest.raises(ValueError, match="regions of several sizes; give one size"):
        run(World(), path, plan)
    run(World(), path, dataclasses.replace(PLAN, settings=(regions[1],)))
    assert Acquisition.load(path).sensor_shape == (4, 5)
    with pytest.raises(ValueError, match="retries = -1: give a whole number from 0"):
        Procedure(retries=-1)


def test_a_journal_that_cannot_be_made_is_told_and_made_later(tmp_path, monkeypatch):
    """As on a disk that has no number for another file."""

    def no_inode(path, flags, *rest):
        if flags & os.O_CREAT:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return os.open(path, flags, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(recorder, "os", SimpleNamespace(**{**vars(os), "open": no_inode}))
        with pytest.raises(WriteError, match="journal.jsonl: cannot be written .*; make room"):
            run(World(), tmp_path / "a.zarr")
    assert run(World(), tmp_path / "a.zarr").complete
