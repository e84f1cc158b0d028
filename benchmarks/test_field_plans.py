"""Coverage of plans over the field: predicted against true errors of 140 random cameras.

Zone plates, arrays, random cells and phase masks before spots of a field of up to ±45°, each spot
with its own PSF (`tests/lensless/plan/spots.py`).
"""

import warnings

import numpy as np
import pytest
from lensless.plan.spots import errors


@pytest.mark.parametrize(
    ("kind", "count"), [("plate", 40), ("mura", 40), ("random", 40), ("phase", 20)]
)
def test_predictions_over_the_field(benchmark, kind, count):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, predicted, true, choice, _ = errors(count, seed=20261127, kind=kind).T
    rates = np.mean(true <= predicted), np.mean(predicted <= 10 * true)
    benchmark.extra_info["covered, within ten, choices"] = [
        *rates,
        *np.bincount(choice.astype(int)),
    ]
    print(kind, benchmark.extra_info)
    assert rates[0] >= 0.99 and rates[1] >= 0.8
    benchmark.pedantic(lambda: None)
