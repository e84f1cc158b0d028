"""What an acquisition costs beside exposure, settling and transfer, a frame.

An instant camera in memory, whose frames differ. Frames of a stack are kept each as a whole, those
of a Hadamard plan by rows, 16 together. The frames are on the disk (fsync) when the time is taken;
what the disk takes for one fsync is printed beside it. The least of three runs counts.
"""

import os
import shutil
import time

import numpy as np
import pytest
from hardware.memory_rig import World, by_rows, fiducial_plan

from thincam_jax.hardware.acquisition.acquire import acquire

FRAMES = {512: 128, 2048: 32}


def fsync_time(folder, size=1):
    """Median time, s, of writing and syncing a file of so many bytes."""
    times, data = [], os.urandom(size)
    for number in range(15):
        with open(folder / f"sync{number}", "wb", buffering=0) as file:
            start = time.perf_counter()
            file.write(data)
            os.fsync(file.fileno())
            times.append(time.perf_counter() - start)
    return np.median(times)


@pytest.mark.parametrize("kept", ["frame by frame", "by rows"])
@pytest.mark.parametrize("side", list(FRAMES))
def test_overhead(side, kept, tmp_path):
    texture = np.random.default_rng(0).integers(100, 2000, side * (side + 8)).astype(np.uint16)
    world = World((side, side))
    world.see = lambda exposure: see(world, texture)
    plan = fiducial_plan(FRAMES[side], every=16)
    if kept == "by rows":
        plan = by_rows(plan)
    overheads = [measure(world, plan, tmp_path / str(n)) for n in range(3)]
    world.pause = 0.015  # a camera that takes its time, in which frames reach the disk
    beside = measure(world, plan, tmp_path / "slow")
    sizes = {"a line": 200, "a frame": 2 * side**2}
    syncs = {what: f"{1e3 * fsync_time(tmp_path, size):.2f} ms" for what, size in sizes.items()}
    print(
        f"\n{side}², {kept}: ms a frame beside the camera's: {overheads}, "
        f"{beside} where a frame takes 15 ms; fsync: {syncs}"
    )
    if side == 512:
        assert beside < 5


def measure(world, plan, path):
    """ms a frame of wall time, without the camera's."""
    with world.rig() as rig:
        start, cpu = time.perf_counter(), time.process_time()
        done = acquire(plan, rig, path)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    spent = {what: f"{1e3 * s / done.total:.2f}" for what, s in done.seconds.items()}
    print(f"{1e3 * cpu / done.total:.2f} ms of CPU time a frame; wall time of the steps: {spent}")
    shutil.rmtree(path)
    return round(1e3 * (wall - done.seconds["trigger"]) / done.total, 2)


def see(world, texture):
    """A view of the texture that differs from step to step, with the fiducial in it."""
    side, number = world.shape[0], int(world.shown[0, 0])
    pixels = texture[8 * number : 8 * number + side**2].reshape(side, side)
    pixels[0, :4] = world.shown[0, :4]
    return pixels
