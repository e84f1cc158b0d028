"""An acquisition takes the frames of its plan, and no others, whatever goes wrong."""

import numpy as np
import pytest

from hardware.memory_rig import SETTINGS, SHAPE, World, fiducial, fiducial_plan
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import read_acquisition

QUICK = Procedure(timeout=0.001, reopen_wait=0.0)


def shown(path):
    """The fiducials of a store, in the order of its steps."""
    taken = read_acquisition(path)
    return [fiducial(taken.frame(number)) for number in range(len(taken.plan.steps))]


def expected(plan):
    return [-1 if step.dark else step.pattern for step in plan.steps]


def test_every_step_has_its_frame(tmp_path):
    plan, heard = fiducial_plan(20, dark_every=8), []
    with World().rig() as rig:
        done = acquire(plan, rig, tmp_path / "a.zarr", procedure=QUICK, progress=heard.append)
    assert done.complete and not done.recovered
    assert [p.done for p in heard] == list(range(1, 24)) and heard[-1].remaining == 0
    assert shown(tmp_path / "a.zarr") == expected(plan)
    taken = read_acquisition(tmp_path / "a.zarr")
    assert taken.plan == plan and taken.bits == 12 and taken.sensor_shape == SHAPE
    assert taken.captures().shape == (20, *SHAPE)
    assert taken.distances[:7] == [0, 0, 0, 0, 0, 1, 1]
    assert taken.settings[0].exposure == SETTINGS.exposure
