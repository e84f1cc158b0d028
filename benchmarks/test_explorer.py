"""A move of a slider in the explorer, from its value to the message with the PSF: 512² pixels."""

import jax
import numpy as np

import thincam_jax as tc
from thincam_jax.plot.explorer import Explorer
from thincam_jax.units import um

MOVES, MOST = 200, 0.025  # seconds, 95 % of the moves


def test_a_move_is_shown_at_once(benchmark):
    with jax.enable_x64(False):
        mask = tc.FresnelZoneAperture(25.0, width=5.632)
        explorer = Explorer(tc.LenslessCamera(mask, tc.Sensor((512, 512), 11 * um), distance=6.5))
        betas = iter(np.resize(np.linspace(20, 30, 37), MOVES + 10))

        def move():
            explorer.turn({"beta": float(next(betas))})
            return explorer.view(rest=False).message()

        benchmark.pedantic(move, rounds=MOVES, warmup_rounds=5)
    assert np.percentile(benchmark.stats.stats.data, 95) < MOST
