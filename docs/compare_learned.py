"""What the distance in the optics is worth: networks trained alike, with it and without.

`python docs/compare_learned.py CONFIG IMAGES TUNING [COUNT] [STEPS] [POOL]`, as
docs/score_refocusing.py, for a camera of a quarter of the pixels. Networks
and codes are trained on the same scenes, for the same CPU time:

- the network of the package, for any distance, and on scenes at 60 and 120 mm alone;
- the control code of the thesis (chapter 4): a U-Net that is told the distance as a number beside
  the linear inversion at the middle distance; trained on both, too;
- `UnrolledAdmm`: five iterations of ADMM-TV with learnt penalties, which are few: 60 steps on 24
  flat scenes of TUNING.
"""

import dataclasses
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
from score_refocusing import (
    FAR,
    NEAR,
    Methods,
    Shot,
    head,
    one_plane,
    rectangle,
    row,
    squares,
    tune,
    two_planes,
)

from thincam_jax import learn
from thincam_jax.commands.learned.build import build_lessons, build_network, build_options
from thincam_jax.commands.learned.config import load_learned
from thincam_jax.learn.refocusing.baselines import ControlCode, control_loss
from thincam_jax.learn.refocusing.unet import parameter_count
from thincam_jax.learn.training import Task, train_model
from thincam_jax.learn.unrolled import UnrolledAdmm, train
from thincam_jax.reconstruction.problem import InverseProblem

SMALL = (
    *("sensor.shape=[128, 128]", "sensor.pitch=88 um", "focus.shape=[64, 64]"),
    *("scenes.side=192", "network.widths=[32, 32, 32, 32]"),
)
UNTRAINED = (52.0, 75.0, 95.0, 150.0, 190.0)
OTHERS = (80.0, 170.0)  # another pair of planes


class Coded:
    """The control code as a method."""

    def __init__(self, lessons, network, options, seconds: float):
        """Trained for some CPU time."""
        camera = network.camera
        model = ControlCode.create(camera, (48, 64, 64, 64), key=jax.random.key(3))
        batches = list(lessons.drawn(network, options.seed, lessons.pool))

        def draw(key):
            chosen, mirrors = jax.random.split(key)
            batch = batches[int(jax.random.randint(chosen, (), 0, len(batches)))]
            turns = tuple(1 - 2 * int(m) for m in jax.random.bernoulli(mirrors, shape=(2,)))
            turned = (slice(None), *(slice(None, None, turn) for turn in turns))
            return batch._replace(capture=batch.capture[turned], image=batch.image[turned])

        nothing = jax.tree.map(lambda _: False, model)
        learned = eqx.tree_at(lambda m: (m.step, m.unet), nothing, (True, True))
        task = Task(draw, control_loss, lessons.validation(network, options.seed), learned)
        # The first run compiles, the second tells how long a step takes.
        short = dataclasses.replace(options, steps=20, check_every=20)
        for _ in range(2):
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

    def __init__(self, camera, pictures):
        self.camera = camera
        shots = [one_plane(camera, pictures[n % len(pictures)], 85.0, 5000 + n) for n in range(24)]
        problem = self.problem(shots, 85.0)
        images = jnp.stack([shot.target(camera, 85.0) for shot in shots])[:, None, None]
        model = UnrolledAdmm(problem, 5)
        trained = train(model, problem, images, key=jax.random.key(4), steps=60)
        self.model = trained.model

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


def trained_networks(config) -> tuple[dict, float]:
    """The package's network on both kinds of scenes, and the CPU time of the first."""
    options, lessons, found, took = build_options(config), build_lessons(config), {}, []
    for name, kinds in kinds_of(lessons).items():
        began = time.process_time()
        network = build_network(config)
        found[name] = learn.train(network, lessons._replace(scenes=kinds), options).model
        took.append(time.process_time() - began)
        print(f"network, {name}: {took[-1]:.0f} s of CPU", flush=True)
    return found, took[0]


def kinds_of(lessons) -> dict:
    scenes = lessons.scenes
    return {"any distance": scenes, "60 and 120 mm": scenes._replace(distances=(NEAR, FAR))}


def main(config, images: str, tuned: str, count: int) -> None:
    networks, seconds = trained_networks(config)
    network = networks["any distance"]
    camera, options, lessons = network.camera, build_options(config), build_lessons(config)
    side = 5 * max(camera.field_shape) // 4
    pictures, known = (squares(folder, camera, side) for folder in (images, tuned))
    methods = Methods(network)
    tune(methods, known, min(count, 6))
    runs = {"Wiener": methods.wiener, "ADMM-TV": methods.admm}
    runs["UnrolledAdmm"] = Unrolled(camera, known).focus
    for name, kinds in kinds_of(lessons).items():
        coded = Coded(lessons._replace(scenes=kinds), network, options, seconds)
        runs[f"code, {name}"] = coded.focus
    for name, one in networks.items():
        runs[f"network, {name}"] = Methods(one).learned
    head(runs)
    for t in (NEAR, FAR, *UNTRAINED):
        shots = [one_plane(camera, pictures[n], t, n) for n in range(count)]
        row(f"one plane, {t:g} mm", camera, runs, shots, t)
    for distances in ((NEAR, FAR), OTHERS):
        shots = [
            two_planes(
                camera,
                (pictures[n], pictures[-1 - n]),
                rectangle(camera.field_shape, n),
                n,
                distances,
            )
            for n in range(count)
        ]
        for t in distances:
            row(f"two planes, {t:g} mm", camera, runs, shots, t)


if __name__ == "__main__":
    path, images, tuned, *more = sys.argv[1:]
    count, steps, pool = more + ["8", "4000", "120"][len(more) :]
    config = load_learned(path, (*SMALL, f"training.steps={steps}", f"training.pool={pool}"))
    main(config, images, tuned, int(count))
