"""What the distance in the optics is worth: networks trained alike, with it and without.

`python compare_learned.py IMAGES TUNING [COUNT] [STEPS] [POOL] [SEEDS]`, as
score_refocusing.py, for a camera of a quarter of the pixels. Networks and codes are trained
on the same scenes, of TUNING, scikit-image's photographs and drawn ones, for the same CPU time
(without compiling; the network's with drawing them), with so many seeds of scenes, weights and
noise:

- the network of the package, for any distance, and on scenes at 60 and 120 mm alone;
- the control code of the thesis (chapter 4): a U-Net that is told the distance as a number beside
  the linear inversion at the middle distance; trained on both, too. What is trained on two
  distances is so with the first seed alone;
- `UnrolledAdmm`: five iterations of ADMM-TV with learnt penalties, which are few: 60 steps on 24
  flat scenes of TUNING.

A table for each seed as it ends; then that of all, and what the network gains on the others.
"""

import dataclasses
import sys
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from refocusing_baselines import ControlCode, control_loss
from scipy.stats import t as student
from score_refocusing import (
    FAR,
    NEAR,
    Methods,
    Shot,
    halves,
    head,
    one_plane,
    rectangle,
    refocus_camera,
    row,
    squares,
    tune,
    two_planes,
)

from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.sources import drawn, photographs, samples
from thincam_jax.learn.refocusing.train import Lessons
from thincam_jax.learn.refocusing.unet import parameter_count
from thincam_jax.learn.training import Task, TrainingOptions, train_model
from thincam_jax.learn.unrolled import Adam, UnrolledAdmm, train
from thincam_jax.reconstruction.problem import InverseProblem

PIXELS, SIDE = 128, 192  # of the sensor, and of the images that scenes are cut of
UNTRAINED = (52.0, 75.0, 95.0, 150.0, 190.0)
OTHERS = (80.0, 170.0)  # another pair of planes


class Coded:
    """The control code as a method."""

    def __init__(self, lessons, network, options, seconds: float):
        """Trained for some CPU time."""
        camera = network.camera
        key = jax.random.fold_in(jax.random.key(3), options.seed)
        model = ControlCode.create(camera, (48, 64, 64, 64), key=key)
        batches = list(lessons.drawn(network, options.seed, lessons.pool))

        def draw(key):
            chosen, mirrors = jax.random.split(key)
            batch = batches[int(jax.random.randint(chosen, (), 0, len(batches)))]
            turns = tuple(1 - 2 * int(m) for m in jax.random.bernoulli(mirrors, shape=(2,)))
            turned = (slice(None), *(slice(None, None, turn) for turn in turns))
            return dataclasses.replace(
                batch, capture=batch.capture[turned], image=batch.image[turned]
            )

        nothing = jax.tree.map(lambda _: False, model)
        learned = eqx.tree_at(lambda m: (m.step, m.unet), nothing, (True, True))
        task = Task(draw, control_loss, lessons.validation(network, options.seed), learned)
        # The first run compiles, the second tells how long a step takes.
        short = dataclasses.replace(options, steps=20, check_every=20)
        train_model(task, model, short)
        began = time.process_time()
        train_model(task, model, short)
        steps = int(20 * seconds / (time.process_time() - began))
        whole = dataclasses.replace(options, steps=steps)
        self.model = train_model(task, model, whole).model
        print(f"control code: {parameter_count(self.model.unet)} numbers, {steps} steps")

    def focus(self, shot: Shot, distance: float):
        return _coded(self.model, shot.capture, jnp.float32(distance), shot.deviation)


class Unrolled:
    """`UnrolledAdmm` as a method: all of the scene stands at the distance."""

    def __init__(self, camera, pictures, seed: int):
        self.camera = camera
        shots = [
            one_plane(camera, pictures[n % len(pictures)], 85.0, 5000 + 100 * seed + n)
            for n in range(24)
        ]
        problem = self.problem(shots, 85.0)
        images = jnp.stack([shot.target(camera, 85.0) for shot in shots])[:, None, None]
        model = UnrolledAdmm(problem, 5)
        key = jax.random.fold_in(jax.random.key(4), seed)
        self.model = train(model, problem, images, key=key, descent=Adam(steps=60)).model

    def problem(self, shots, distance: float) -> InverseProblem:
        captures = jnp.stack([shot.capture for shot in shots])[:, None]
        weights = jnp.stack([1 / shot.deviation**2 for shot in shots]).reshape(-1, 1, 1, 1)
        operator = self.camera.operator(jnp.asarray([distance], captures.dtype))
        return InverseProblem(operator, captures, weights=[weights])

    def focus(self, shot: Shot, distance: float):
        return _unrolled(self.model, self.problem([shot], distance))[0, 0, 0]


@eqx.filter_jit
def _coded(model, capture, distance, deviation):
    return model.focus(capture, distance, deviation)


@eqx.filter_jit
def _unrolled(model, problem):
    return model(problem)


def untrained(seed: int) -> RefocusNetwork:
    options = NetworkOptions(steps=2, widths=(32, 32, 32, 32))
    return RefocusNetwork.create(refocus_camera(PIXELS), options, key=seed)


def learned(lessons, options, known) -> dict[str, Callable]:
    """All that is trained, by the seed of the options: `known` pictures for the iterations."""
    network = untrained(options.seed)
    kinds = {"any distance": lessons.scenes}
    if not options.seed:
        kinds["60 and 120 mm"] = dataclasses.replace(lessons.scenes, distances=(NEAR, FAR))
    runs = {"UnrolledAdmm": Unrolled(network.camera, known, options.seed).focus}
    codes, networks = {}, {}
    for name, scenes in kinds.items():
        given, began = dataclasses.replace(lessons, scenes=scenes), time.process_time()
        networks[f"network, {name}"] = Methods(train_network(network, given, options).model).learned
        seconds = time.process_time() - began
        print(f"network, {name}: {seconds:.0f} s of CPU", flush=True)
        codes[f"code, {name}"] = Coded(given, network, options, seconds).focus
    return {**runs, **codes, **networks}


def table(camera, runs: dict[str, Callable], pictures, count: int, seed: int) -> dict:
    """PSNR by test and method, (photograph); printed as it is found."""
    noise, found = 1000 * seed, {}
    pairs = [(pictures[n], pictures[-1 - n]) for n in range(count)]

    def test(name, shots, t):
        name = f"{name}, {t:g} mm"
        found[name] = dict(zip(runs, row(name, camera, runs, shots, t), strict=True))

    head(runs)
    for t in (NEAR, FAR, *UNTRAINED):
        shots = [one_plane(camera, pictures[n], t, noise + n) for n in range(count)]
        test("one plane", shots, t)
    for distances in ((NEAR, FAR), OTHERS):
        shots = [
            two_planes(camera, pair, rectangle(camera.field_shape, n), noise + n, distances)
            for n, pair in enumerate(pairs)
        ]
        for t in distances:
            test("two planes", shots, t)
    for is_left in (True, False):
        shots = halves(camera, pairs, is_left, 200 + noise)
        for t in (NEAR, FAR):
            test(f"near half {'left' if is_left else 'right'}", shots, t)
    return found


def summary(tables: list[dict]) -> None:
    """Means over photographs and seeds; what the network gains; what swapped halves change."""
    names = list(tables[0][f"one plane, {NEAR:g} mm"])
    best = "network, any distance"
    every = [name for name in names if name in tables[-1][f"one plane, {NEAR:g} mm"]]
    of = {
        test: {name: np.stack([t[test][name] for t in tables if name in t[test]]) for name in names}
        for test in tables[0]
    }
    head(names)
    for test, found in of.items():
        print(f"| {test} | " + " | ".join(f"{found[n].mean():.2f}" for n in names) + " |")
    print(f"\nWhat '{best}' gains on each")
    head(n for n in every if n != best)
    groups = {
        "one plane, mean": [test for test in of if test.startswith("one plane")],
        "two planes, mean": [test for test in of if test.startswith("two planes")],
    }
    for test, members in {**{test: [test] for test in of}, **groups}.items():
        gains = [
            interval(np.mean([of[m][best] - of[m][n] for m in members], axis=0))
            for n in every
            if n != best
        ]
        print(f"| {test} | " + " | ".join(gains) + " |")
    print("\nWhat a swap of the halves adds")
    head(names)
    for t in (NEAR, FAR):
        left, right = (of[f"near half {side}, {t:g} mm"] for side in ("left", "right"))
        print(f"| {t:g} mm | " + " | ".join(interval(right[n] - left[n]) for n in names) + " |")


def interval(values: np.ndarray) -> str:
    """The mean of (seed, photograph) and half of its 95 % interval, over both."""
    halves = [
        student.ppf(0.975, len(v) - 1) * v.std(ddof=1) / len(v) ** 0.5
        for v in (values.mean(axis=0), values.mean(axis=1))
        if len(v) > 1
    ]
    return f"{values.mean():+.2f} ± {np.hypot.reduce(halves):.2f}"


def main(images: str, tuned: str, count: int, pool: int, trainings) -> None:
    methods = Methods(untrained(0))
    camera = methods.camera
    side = 5 * max(camera.field_shape) // 4
    pictures, known = (squares(folder, camera, side) for folder in (images, tuned))
    tune(methods, known, min(count, 6))
    plain, tables = {"Wiener": methods.wiener, "ADMM-TV": methods.admm}, []
    # Compiled before any time is taken.
    source = samples(SIDE) + photographs(tuned, SIDE) + drawn(0, 40, SIDE)
    lessons = Lessons(source, pool=pool, held_out=drawn(1, 8, SIDE))
    short = dataclasses.replace(trainings[0], steps=2, check_every=1)
    train_network(methods.network, dataclasses.replace(lessons, pool=1), short)
    for options in trainings:
        runs = {**plain, **learned(lessons, options, known)}
        tables.append(table(camera, runs, pictures, count, options.seed))
    summary(tables)


if __name__ == "__main__":
    images, tuned, *more = sys.argv[1:]
    count, steps, pool, seeds = more + ["8", "4000", "120", "3"][len(more) :]
    told = {"steps": int(steps), "rate": 6e-4, "check_every": 300}
    trainings = [TrainingOptions(**told, seed=seed) for seed in range(int(seeds))]
    main(images, tuned, int(count), int(pool), trainings)
