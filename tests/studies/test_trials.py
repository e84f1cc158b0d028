"""Methods over several seeds: means, deviations, and gains over the first method."""

import numpy as np
import pytest

from thincam_jax.studies.evaluate import Resolved, Scores
from thincam_jax.studies.trials import compare_trials


def scores(psnr, step):
    resolved = None if step is None else Resolved(step // 6, step % 6, 2.0 ** -(step / 6), 1.0)
    return Scores(psnr, 0.5, 0.1, resolved)


def test_gains_are_taken_seed_by_seed():
    trials = {
        "a": {"old": [scores(20.0, 7), scores(22.0, 8)], "new": [scores(20.5, 9), scores(22.9, 8)]}
    }
    compared = compare_trials(trials)
    assert compared["old"]["a"].gain_db is None
    gain = compared["new"]["a"].gain_db
    assert gain.values == [0.5, 0.9]
    assert gain.mean == 0.7
    assert gain.deviation == pytest.approx(np.std([0.5, 0.9], ddof=1), abs=1e-4)
    assert compared["new"]["a"].gain_elements.values == [2, 0]
    # Not resolved, or exact: no number is made up.
    trials["a"]["old"][0] = scores(None, None)
    compared = compare_trials(trials)
    assert compared["new"]["a"].gain_db is None
    assert compared["new"]["a"].gain_elements is None
    assert compared["old"]["a"].resolved_object_mm[0] is None
