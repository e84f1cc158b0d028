"""Designs for target responses: the network with two Gauss–Newton steps, and the search beside it.

The thesis' four captures at 30 dB, in single precision. Held-out targets are responses of designs
of the space; of the others, flat, shifted and turned round ones, no design gives any.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax import design, learn
from thincam_jax.learn.suggester_training import _examples, train_suggester
from thincam_jax.learn.suggestions import propose, refine
from thincam_jax.reconstruction import phase_pairs

HELD_OUT = 200
BETAS = (design.Variable("beta", 8.0, 36.0, (0, 1)), design.Variable("beta", 8.0, 36.0, (2, 3)))
DISTANCES = (
    design.Variable("distance", 4.0, 6.5, (0, 1)),
    design.Variable("distance", 4.0, 6.5, (2, 3)),
)
SPACES = {"two beta": BETAS, "two beta, two distances": BETAS + DISTANCES}


def problem(kind):
    base = design.shots([25.0, 21.0], 6.5, (0.0, 1.5 * np.pi), wavelength=500e-6, width=5.632)
    camera = design.Setup(
        pitch=5.5e-3,
        sensor_width=5.632,
        object_distance=250.0,
        object_width=150.0,
        noise=design.SignalNoise(30.0),
        prior=design.PowerLaw(2.8),
    )
    frequencies = design.Polar(96.0, 128, 2)
    return design.DesignSpace(base, SPACES[kind]), camera, jnp.asarray(phase_pairs(2)), frequencies


def targets(model):
    """Attainable ones, and others: 8 flat, 6 shifted, 6 turned round."""
    points = jax.random.uniform(jax.random.key(2026), (HELD_OUT, model.space.size))
    attainable = jax.jit(jax.vmap(model.levels))(points)
    flat = jnp.linspace(2.0, 40.0, 8)[:, None] * jnp.ones(model.rings)
    shifts = jnp.array([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0])[:, None]
    shifted = jnp.maximum(attainable[:6] + shifts, 0.0)
    return attainable, jnp.concatenate([flat, shifted, attainable[6:12, ::-1]])


@jax.jit
def network_alone(suggester, target):
    guesses = suggester(target)
    misfits = jax.vmap(suggester.model.misfit, in_axes=(0, None))(guesses, target)
    return guesses[jnp.argmin(misfits)], jnp.min(misfits)


@jax.jit
def nearest_sample(model, points, levels, target):
    """The example of the training whose levels are nearest, after two Gauss–Newton steps."""
    point = points[jnp.argmin(jnp.mean((levels - target) ** 2, axis=-1))]
    refined, first = refine(model, target, point[None])
    return first[0], model.misfit(refined[0], target)


def each(function, target):
    """Of every target, after one that compiles: what comes out, and the median time, s."""
    jax.block_until_ready(function(target[0]))
    found, times = [], []
    for one in target:
        start = time.perf_counter()
        found.append(jax.block_until_ready(function(one)))
        times.append(time.perf_counter() - start)
    return found, float(np.median(times))


def answers(kind):
    """Misfits and times of all ways, of both kinds of targets."""
    space, *data = problem(kind)
    start = time.perf_counter()
    model = design.ResponseModel(space, *data)
    suggester = train_suggester(model, key=jax.random.key(0)).suggester
    jax.block_until_ready(suggester)
    training = time.perf_counter() - start
    examples = _examples(model, 4096, jax.random.key(1))

    def search(target):
        return design.match_response(model, target, key=jax.random.key(4))

    rows = []
    for name, target in zip(("attainable", "others"), targets(model), strict=True):
        alone, of_alone = each(lambda w: network_alone(suggester, w), target)
        compiled, of_steps = each(lambda w: propose(suggester, w), target)
        told, of_all = each(lambda w: learn.suggest(suggester, w), target)
        nearest, of_nearest = each(lambda w: nearest_sample(model, *examples, w), target)
        searched, of_search = each(search, target)
        evaluations = np.median([s.evaluations for s in searched])
        rows += [
            (name, "network", of_alone, [a[1] for a in alone]),
            (name, "network + 2 Newton", of_steps, [c.misfit_db for c in compiled]),
            (name, "suggest", of_all, [t.misfit_db for t in told]),
            (name, "nearest of 4096", of_nearest, [n[0] for n in nearest]),
            (name, "nearest + 2 Newton", of_nearest, [n[1] for n in nearest]),
            (name, f"search, {evaluations:.0f} evals", of_search, [s.misfit_db for s in searched]),
        ]
    return training, suggester, rows


@pytest.mark.parametrize("kind", SPACES)
@pytest.mark.benchmark(group="suggest")
def test_suggest(benchmark, kind, capsys):
    with jax.enable_x64(False):
        training, suggester, rows = answers(kind)
        target = jnp.asarray(targets(suggester.model)[0][0])
        benchmark.pedantic(lambda: jax.block_until_ready(propose(suggester, target)), rounds=50)
    with capsys.disabled():
        print(f"\n\n{kind}: trained in {training:.0f} s\n")
        print("| targets | by | time, ms | median, dB | 95 %, dB | within 1 dB |")
        for name, way, seconds, misfits in rows:
            misfits = np.asarray(misfits, float)
            median, most = np.percentile(misfits, [50, 95])
            part = np.mean(misfits <= 1.0)
            print(
                f"| {name} | {way} | {1e3 * seconds:.2f} | {median:.3f} | {most:.2f} | {part:.0%} |"
            )
            benchmark.extra_info[f"{name}, {way}"] = (seconds, median, most)
        by = {(name, way.split(",")[0]): (s, np.median(m)) for name, way, s, m in rows}
        for name in ("attainable", "others"):
            ratio = by[name, "search"][0] / by[name, "network + 2 Newton"][0]
            print(f"{name}: the search takes {ratio:.0f} times as long")
        print()
    network, refined = (by["attainable", w][1] for w in ("network", "network + 2 Newton"))
    assert refined < network
