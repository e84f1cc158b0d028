"""Requests of plans: the steps of each kind, and what a kind lacks or does not take."""

import numpy as np
import pytest

from thincam_jax._core.quantity import FieldError
from thincam_jax.hardware.acquisition.request import PlanRequest
from thincam_jax.hardware.base import CameraSettings

SETTINGS = CameraSettings(exposure=0.02)
ZONES = {"betas": (25.0,), "width": 1.4}


@pytest.mark.parametrize(
    ("request_", "kinds", "positions"),
    [
        (PlanRequest("fringe_scan", **ZONES, dark_frames=1), 5, {None}),
        (PlanRequest("method_b", betas=(25.0, 21.0), width=1.4), 4, {None}),
        (PlanRequest("method_a", **ZONES, distances=(5.0, 6.5)), 8, {-1.5, 0.0}),
        (PlanRequest("psf_stack", **ZONES, distances=(16.5,), phase=1.0), 1, {10.0}),
        (PlanRequest("hadamard", cells=(4, 8), dark_frames=2), 66, {None}),
        (PlanRequest("pictures", cells=(2, 3), frames=3, dark_frames=1), 7, {None}),
        (PlanRequest("scene", frames=3, dark_frames=1), 4, {None}),
        (PlanRequest("grey_levels", frames=2), 36, {None}),
        (
            PlanRequest("alignment", **ZONES, marks=(3, 4), spread=60.0, size=4.0, frames=2),
            24,
            {None},
        ),
        (PlanRequest("scene", exposures=(0.1, 1.0), frames=3, dark_frames=2), 10, {None}),
    ],
    ids=lambda given: getattr(given, "kind", ""),
)
def test_steps(request_, kinds, positions):
    shown = {name: np.full((2, 3), level, np.uint8) for name, level in (("a", 9), ("b", 200))}
    plan = request_.plan(SETTINGS, stage_zero=6.5, shown=shown)
    assert plan.name == request_.kind
    assert len(plan.steps) == kinds
    assert {step.position for step in plan.steps} == positions


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        ({"kind": "method_b", **ZONES}, "betas", "compares two β or more"),
        (
            {"kind": "fringe_scan", **ZONES, "frames": 2},
            "frames",
            "takes betas, width, profile, mosaic;",
        ),
        ({"kind": "method_a", **ZONES}, "distances", "a plan of kind method_a needs it"),
        ({"kind": "pictures"}, "cells", "needs it"),
        ({"kind": "method_a", **ZONES, "distances": (5.0, 5.0)}, "distances", "stands twice"),
        ({"kind": "hadamard", "cells": (3, 5)}, "cells", "power of two"),
        ({"kind": "scene", "exposures": (0.1, 0.1)}, "frames", "noise of each; give 2 or more"),
        ({"kind": "scene", "betas": (25.0, 21.0)}, "betas", "has one β; give one"),
    ],
)
def test_what_does_not_fit(given, field, message):
    with pytest.raises(FieldError, match=message) as caught:
        PlanRequest(**given)
    assert caught.value.field == field
