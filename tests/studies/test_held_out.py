"""Gains on further photographs: each as if simulated alone, and the interval of the mean."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from studies import tiny

import thincam_jax as tc
from thincam_jax.studies import trials as module
from thincam_jax.studies.study import Target
from thincam_jax.studies.trials import (
    GainOverPhotographs,
    further_photographs,
    hold_out,
    simulate_trials,
)


def test_the_interval_is_that_of_the_mean():
    """Of 1,000 sets of twelve gains of 0.3 ± 0.2 dB it holds the mean in 95 %."""
    values = [0.1, 0.4, 0.25, 0.6]
    gain = GainOverPhotographs.of(values)
    low, high = scipy.stats.t.interval(0.95, 3, np.mean(values), scipy.stats.sem(values))
    assert (gain.mean, gain.low, gain.high) == pytest.approx((0.3375, low, high), abs=1e-4)
    assert str(gain) == f"+0.34 dB (95 %: {low:+.2f} to {high:+.2f})"
    random = np.random.default_rng(0)
    sets = [GainOverPhotographs.of(random.normal(0.3, 0.2, 12)) for _ in range(1000)]
    assert np.mean([one.low < 0.3 < one.high for one in sets]) == pytest.approx(0.95, abs=0.02)


def test_photographs_that_are_used_are_left_out():
    names = further_photographs(("camera", "coins"), 12)
    assert len(names) == 12 == len(set(names))
    assert not {"camera", "coins", "cat", "logo", "text"} & set(names)


def test_each_photograph_is_as_if_it_were_alone(monkeypatch):
    """With hardly any noise, whose key is the target's own."""
    monkeypatch.setattr(module, "_PIXELS", 60)
    study = replace(tiny.study(), noise=tc.GaussianNoise(120.0))
    found = hold_out(study, ("camera", "chelsea"))
    first, *others = study.methods
    assert found.photographs == ("camera", "chelsea")
    assert [*found.gains] == [method.name for method in others]
    distance, width = study.object_distance, study.targets[0].width
    for place, name in enumerate(found.photographs):
        target = Target.of_image(name, module._square(name), distance, width, "photograph")
        alone = simulate_trials(study, target, 1)
        for method in others:
            levels = [alone[one.name][0].psnr_db or 0.0 for one in (method, first)]
            expected = levels[0] - levels[1]
            assert found.gains[method.name].values[place] == pytest.approx(expected, abs=2e-3)
