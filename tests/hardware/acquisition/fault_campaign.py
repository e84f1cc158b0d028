"""Every fault, many times at random moments of an acquisition: what came of it, as a table.

`python fault_campaign.py 100` prints it for the docs.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from hardware.memory_rig import World, fiducial_plan

from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import read_acquisition
from thincam_jax.hardware.errors import Busy, HardwareError, NotHomed, ProtocolError
from thincam_jax.hardware.virtual.faults import FAULTS, Fault

# What stops a run, to be taken up again; every other fault is recovered from.
STOPS = {
    "nak": ProtocolError, "busy": Busy, "lost_steps": NotHomed, "wrong_checksum": ProtocolError
}  # fmt: skip


class Row(NamedTuple):
    """How often a fault was played, was recovered from, and stopped the run."""

    fault: Fault
    injected: int
    recovered: int
    stopped: int


def campaign(fault: Fault, times: int, folder: Path, seed: int = 0) -> Row:
    """One acquisition with that many faults, taken up again after each stop.

    AssertionError for a wrong error, and for a frame that is not that of its step.
    """
    random = np.random.default_rng([seed, FAULTS.index(fault)])
    plan = fiducial_plan(4 * times, every=2, dark_every=10)
    moments = set(random.choice(len(plan.steps) - 8, times, replace=False) + 2)
    world, stopped, recovered, complete = World(), 0, 0, False

    def inject(now):
        if now.done in moments:
            moments.remove(now.done)
            world.unplugs = str(random.choice(["camera", "display", "stage"]))
            world.faults.inject(fault)

    def whole():
        """What was played without stopping the run has been recovered from."""
        return sum(world.faults.happened.values()) - stopped

    procedure = Procedure(timeout=0.001, reopen_wait=0.0, retries=5)
    while not complete:
        try:
            with world.rig() as rig:
                run = acquire(plan, rig, folder / "store", procedure=procedure, progress=inject)
            complete = run.complete
        except HardwareError as error:
            assert type(error) is STOPS.get(fault), error
            stopped += 1
            world.homed = True
    recovered = whole()
    require_right(folder / "store", plan)
    return Row(fault, world.faults.happened[fault], recovered, stopped)


def require_right(path: Path, plan) -> None:
    """AssertionError where a frame of a store is not, pixel for pixel, that of its step."""
    taken, world = read_acquisition(path), World()
    for number, step in enumerate(plan.steps):
        world.shown = world.render(plan.pattern(step))
        exposure = taken.settings[step.settings].exposure
        np.testing.assert_array_equal(taken.frame(number), world.see(exposure))
    digests = [taken.shots[number]["digest"] for number in taken.lit]
    assert len(set(digests)) == len(digests)


def table(times: int) -> str:
    """The rows of all faults in Markdown."""
    lines = ["| fault | injected | recovered | stopped, resumed |", "|---|---|---|---|"]
    for fault in FAULTS:
        with TemporaryDirectory() as folder:
            row = campaign(fault, times, Path(folder))
        error = f" ({STOPS[fault].__name__})" if fault in STOPS else ""
        lines.append(f"| {fault} | {row.injected} | {row.recovered} | {row.stopped}{error} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(int(sys.argv[1])))
