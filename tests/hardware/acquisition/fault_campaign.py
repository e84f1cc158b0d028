"""Every fault, many times at random moments of an acquisition: what came of it, as a table.

`python fault_campaign.py 100` prints it for the docs, of the plans `fiducials`, `pictures` and
`scene`; `python fault_campaign.py 100 scene` of one of them.
"""

import os
import signal
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import pytest
from hardware.memory_rig import World, fiducial, fiducial_plan, number_of, picture_plan, scene_plan

from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.plan import BLACK
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.base import Busy, HardwareError, NotHomed, ProtocolError
from thincam_jax.hardware.virtual.devices import FAULTS, Fault

# What stops a run, to be taken up again; every other fault is recovered from.
STOPS = {
    "nak": ProtocolError, "busy": Busy, "lost_steps": NotHomed, "wrong_checksum": ProtocolError
}  # fmt: skip
# Of commands that a plan whose stage and exposure stay gives only at the begin of a run.
AT_BEGIN = ("nak", "lost_steps", "wrong_checksum")
# Plans of a number of frames, and the devices that get no command from step to step.
PLANS = {
    "fiducials": (lambda count: fiducial_plan(count, every=2, dark_every=10), ()),
    "pictures": (lambda count: picture_plan(count).at_position(2.0), ("stage",)),
    "scene": (lambda count: scene_plan(count).at_position(2.0), ("stage", "display")),
}


class Row(NamedTuple):
    """How often a fault was played, was recovered from, and stopped the run."""

    fault: Fault
    injected: int
    recovered: int
    stopped: int


def campaign(fault: Fault, times: int, folder: Path, kind: str = "fiducials") -> Row:
    """One acquisition with that many faults, taken up again after each stop.

    AssertionError for a wrong error, for a store that is read before it is complete, and for a
    frame that is not the one that was exposed for its step.
    """
    random = np.random.default_rng([0, FAULTS.index(fault)])
    make, still = PLANS[kind]
    plan = make(4 * times)
    moments = set(random.choice(len(plan.steps) - 8, times - 1, replace=False) + 2)
    world, stopped, complete, path = World(), 0, False, folder / "store"
    world.exposed = []
    world.faults.inject(fault)  # before the first frame

    def inject(now):
        if now.done in moments:
            moments.remove(now.done)
            world.unplugs = str(random.choice(["camera", "display", "stage"]))
            world.faults.inject(fault)
            unplugs = fault == "unplug" and world.unplugs in still
            if unplugs or (still and fault in AT_BEGIN):
                os.kill(os.getpid(), signal.SIGTERM)  # the fault awaits the run that resumes

    exposure = "auto" if kind == "scene" else "given"
    procedure = Procedure(timeout=0.001, reopen_wait=0.0, retries=5, exposure=exposure)
    while not complete:
        try:
            with world.rig() as rig:
                run = acquire(plan, rig, path, procedure=procedure, progress=inject)
            complete = run.complete
        except HardwareError as error:
            assert type(error) is STOPS.get(fault) and "\n" not in str(error), error
            stopped += 1
            world.homed = True
        if not complete:
            incomplete = "frames are missing" if path.exists() else "store"
            with pytest.raises(CaptureStoreError, match=incomplete):
                Acquisition.load(path)
    require_right(path, plan, world.exposed)
    happened = world.faults.happened
    return Row(fault, happened[fault], sum(happened.values()) - stopped, stopped)


def require_right(path: Path, plan, exposed=None) -> None:
    """AssertionError where a frame of a store is not, pixel for pixel, that of its step.

    - `exposed`: what a world has exposed; each frame has to be another one of them.
    """
    taken, world, stamps = Acquisition.load(path), World(), []
    for number, step in enumerate(plan.steps):
        world.shown = world.render(plan.pattern(step))
        exposure, frame = taken.settings[step.settings].exposure, taken.frame(number)
        expected = world.see(exposure)
        if exposed is not None:
            expected[1, :4] = frame[1, :4]
            stamps.append(fiducial(frame[1:]) + 1)
            black = plan.pattern(step) == BLACK
            shown = -1 if black else number_of(plan.pattern(step))
            assert exposed[stamps[-1]] == (shown, exposure)
        np.testing.assert_array_equal(frame, expected)
    assert stamps == sorted(set(stamps))
    digests = [taken.shots[number]["digest"] for number in taken.lit]
    repeats = exposed is None and len(set(map(number_of, taken.patterns))) < len(digests)
    assert repeats or len(set(digests)) == len(digests)


def table(times: int, kind: str) -> str:
    """The rows of all faults in Markdown."""
    lines = [f"| fault, {kind} | injected | recovered | stopped, resumed |", "|---|---|---|---|"]
    for fault in FAULTS:
        with TemporaryDirectory() as folder:
            row = campaign(fault, times, Path(folder), kind)
        error = f" ({STOPS[fault].__name__})" if fault in STOPS else ""
        lines.append(f"| {fault} | {row.injected} | {row.recovered} | {row.stopped}{error} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for name in sys.argv[2:] or PLANS:
        print(table(int(sys.argv[1]), name), flush=True)
