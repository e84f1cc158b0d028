"""A plan is data: the same plan has the same hash, and what it says comes back."""

import dataclasses
import math

import pytest
from hardware.memory_rig import SETTINGS

from thincam_jax.hardware.acquisition.plan import BLACK, AcquisitionPlan, AcquisitionStep, Pattern
from thincam_jax.hardware.base import Region
from thincam_jax.hardware.plans import (
    fringe_scan,
    hadamard,
    method_a,
    method_b,
    psf_stack,
    zone_plate,
)
from thincam_jax.measured.calibration import HadamardSeries

MASK = zone_plate(25.0, 5.6)
PLANS = {
    "fringe_scan": fringe_scan(MASK, SETTINGS),
    "method_a": method_a(MASK, (7.0, 7.5), SETTINGS, stage_zero=5.0, dark_frames=2),
    "method_b": method_b(MASK, (25.0, 21.0), SETTINGS, dark_frames=2),
    "psf_stack": psf_stack(MASK, (100.0, 130.0), SETTINGS, stage_zero=90.0),
    "hadamard": hadamard(HadamardSeries((4, 8), dark_frames=2), SETTINGS),
}


def shown(plan, *names):
    """What each step shows: the numbers of its pattern, or "dark"."""
    return [
        "dark" if step.dark else tuple(plan.pattern(step).numbers[name] for name in names)
        for step in plan.steps
    ]


def test_the_ready_made_plans():
    phases = [(0.0,), (0.5 * math.pi,), (math.pi,), (1.5 * math.pi,)]
    assert shown(PLANS["fringe_scan"], "phase") == phases
    assert {step.position for step in PLANS["fringe_scan"].steps} == {None}
    assert shown(PLANS["method_a"], "phase") == 2 * ["dark", *phases]
    assert [step.position for step in PLANS["method_a"].steps] == 5 * [2.0] + 5 * [2.5]
    pairs = [(25.0, 0.0), (25.0, 1.5 * math.pi), (21.0, 0.0), (21.0, 1.5 * math.pi)]
    assert shown(PLANS["method_b"], "beta", "phase") == ["dark", *pairs[:2], "dark", *pairs[2:]]
    assert shown(PLANS["psf_stack"], "beta") == [(25.0,), (25.0,)]
    assert [step.position for step in PLANS["psf_stack"].steps] == [10.0, 40.0]
    frames = [(number,) for number in range(64)]
    expected = ["dark", *frames[:32], "dark", *frames[32:]]
    assert shown(PLANS["hadamard"], "frame") == expected
    assert PLANS["hadamard"].patterns[-1] == BLACK


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_a_plan_comes_back_with_its_hash(plan):
    again = AcquisitionPlan.from_json(plan.as_json())
    assert again == plan and again.hash == plan.hash
    assert len({other.hash for other in PLANS.values()}) == len(PLANS)


def test_every_part_of_a_plan_changes_its_hash():
    plan = PLANS["method_b"]
    longer = dataclasses.replace(SETTINGS, exposure=0.011)
    smaller = dataclasses.replace(SETTINGS, region=Region(1, 2, 3, 4))
    others = [
        dataclasses.replace(plan, name="other"),
        dataclasses.replace(plan, facts={"pitch": 0.036}),
        dataclasses.replace(plan, settings=(longer,)),
        dataclasses.replace(plan, settings=(smaller,)),
        dataclasses.replace(plan, steps=plan.steps[:-1]),
        dataclasses.replace(plan, steps=(*plan.steps[:-1], AcquisitionStep(0, dark=True))),
        dataclasses.replace(plan, patterns=(*plan.patterns, Pattern("other"))),
    ]
    assert len({plan.hash, *(other.hash for other in others)}) == 8
    assert AcquisitionPlan.from_json(others[3].as_json()) == others[3]
    # The order in which numbers are written does not count.
    turned = Pattern("fza", dict(reversed(list(MASK.numbers.items()))))
    assert method_b(turned, (25.0, 21.0), SETTINGS, dark_frames=2).hash == plan.hash


def test_a_plan_that_cannot_be_done_is_refused():
    with pytest.raises(ValueError, match="'a' has no steps; give at least one"):
        AcquisitionPlan("a", (BLACK,), (SETTINGS,), ())
    with pytest.raises(ValueError, match="step 1 .* points to number 1 of its 1 patterns; give 0"):
        AcquisitionPlan("a", (BLACK,), (SETTINGS,), (AcquisitionStep(0), AcquisitionStep(1)))
    with pytest.raises(ValueError, match="cannot be kept: .*; give finite numbers and texts"):
        method_b(MASK, (math.nan,), SETTINGS)
    with pytest.raises(ValueError, match="kind 'black' has no phase; give a zone_plate"):
        fringe_scan(BLACK, SETTINGS)
    with pytest.raises(ValueError, match="dark_frames = -1; give a whole number"):
        fringe_scan(MASK, SETTINGS, dark_frames=-1)
