"""Patterns a second of a Hadamard plan on the virtual rig: 64² cells, 512² pixels, all through the
camera's protocol, kept with fsync. At least 30 are asked for on two cores that nothing else loads.
"""

import dataclasses
import functools
import time

import jax

from helpers import ROOT
from thincam_jax.commands.checked_config import load_as
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.commands import command
from thincam_jax.hardware.commands.config import CaptureConfig

FRAMES = 480
CELLS, PIXELS, PITCH = "[64, 64]", "[512, 512]", "4.125 um"


def test_hadamard_rate(benchmark, tmp_path):
    asked = {
        "plan.cells": CELLS,
        "camera.pitch": PITCH,
        "virtual.sensor": PIXELS,
        "virtual.screen.object.cells": CELLS,
        "virtual.screen.sensor.shape": PIXELS,
        "virtual.screen.sensor.pitch": PITCH,
        "virtual.screen.band_samples": "2",
        "virtual.response": "1 ms",
    }
    sets = tuple(f"{key}={value}" for key, value in asked.items())
    with jax.enable_x64(False):
        config = load_as(CaptureConfig, ROOT / "configs/rig_hadamard.yaml", sets)
        plan = command.build_plan(config)
        plan = dataclasses.replace(plan, name="part", steps=plan.steps[:FRAMES])
        with command.opened(config, plan) as rig:
            procedure = Procedure(settle=0.002, saturated=0.05)
            start, cpu = time.perf_counter(), time.process_time()
            store = tmp_path / "frames.zarr"
            run = functools.partial(acquire, plan, rig, store, procedure=procedure)
            done = benchmark.pedantic(run, rounds=1)
            wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    spent = {what: f"{1e3 * s / done.total:.2f}" for what, s in done.seconds.items()}
    print(f"\n{done.total / wall:.1f} patterns/s, with {1e3 * cpu / done.total:.1f} ms of CPU each")
    print(f"wall time of the steps, ms: {spent}")
    assert cpu / done.total < 1 / 30
