"""β and d found through the training of a refocusing network, against those for a Wiener filter.

`python design_learned.py [STEPS]`: at 32×32 pixels, drawn scenes with depth, 30 dB. Two
designs by gradient from the same start: with the weights of the network, and for the image of a
Wiener filter whose strength is learnt. Then a network is trained anew for each camera, and judged
on the same unseen scenes; prints a Markdown table.
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from refocusing_baselines import wiener
from refocusing_scores import scores

import thincam_jax as tc
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.learned import read
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.planes import Planes
from thincam_jax.learn.refocusing.scenes import SceneOptions, draw_batch
from thincam_jax.learn.refocusing.sources import drawn
from thincam_jax.learn.refocusing.train import Lessons, examples, loss, relative_error, train
from thincam_jax.learn.training import Task, TrainingOptions, train_model
from thincam_jax.units import nm, um

START, LEAST, MOST = (2.0, 5.0), (0.5, 3.0), (6.0, 9.0)  # β in rad/mm², d in mm
OPTIONS = NetworkOptions(steps=1, widths=(24, 32, 32))
SCENES = SceneOptions(snr_db=(30.0, 30.0), poisson=0.0)


class Optics(eqx.Module):
    """β and d, kept within what can be made."""

    where: jax.Array

    def camera(self, base) -> RefocusCamera:
        least, most = (jnp.log(jnp.asarray(x, self.where.dtype)) for x in (LEAST, MOST))
        beta, distance = jnp.exp(least + (most - least) * jax.nn.sigmoid(self.where))
        return at(base, beta, distance)

    @staticmethod
    def create(beta: float, distance: float) -> "Optics":
        part = np.log(np.divide((beta, distance), LEAST)) / np.log(np.divide(MOST, LEAST))
        return Optics(jnp.asarray(np.log(part / (1 - part)), jnp.float32))


def at(base, beta, distance) -> RefocusCamera:
    return eqx.tree_at(lambda c: (c.camera.mask.beta, c.camera.distance), base, (beta, distance))


def network_loss(model, given):
    """Of optics and weights."""
    optics, weights = model
    base, images, key = given
    camera = optics.camera(base)
    batch = draw_batch(key, images, camera, SCENES, 2)
    seen = examples(RefocusNetwork(weights, Planes(camera), OPTIONS), batch)
    return loss(weights.prior[-1], seen)


def wiener_loss(model, given):
    """Of optics and strength."""
    optics, strength = model
    base, images, key = given
    camera = optics.camera(base)
    batch = draw_batch(key, images, camera, SCENES, 2)
    found = wiener_images(Planes(camera), batch, jnp.exp(strength))
    error = jnp.mean(jax.vmap(relative_error)(found, batch.image))
    return error, {"focus": error}


def wiener_images(planes, batch, strength):
    def one(capture, deviation, commanded):
        return wiener(planes, capture, deviation, commanded, strength)

    return jax.vmap(one)(batch.capture, batch.deviation, batch.commanded)


def base_camera() -> RefocusCamera:
    """With the largest d, whose PSFs and blurs need the most pixels."""
    mask = tc.FresnelZoneAperture(beta=START[0], width=5.0)
    thin = tc.LenslessCamera(mask, tc.Sensor((64, 64), 176 * um), MOST[1])
    return RefocusCamera(thin, 532 * nm, field_shape=(32, 32), near=50.0, far=200.0, planes=5)


def untrained(camera):
    return RefocusNetwork.create(camera, OPTIONS, key=jax.random.key(0)).weights


def found_optics(base, images, model, of, steps: int) -> Optics:
    options = TrainingOptions(steps=steps, rate=3e-3, check_every=steps)
    task = Task(lambda key: (base, images, key), of)
    # Nothing judges it: its optics move until the last step.
    state = train_model(task, model, options).state
    optics, _ = eqx.combine(state.averaged, model)
    return optics


def judged(base, optics: Optics, source, steps: int) -> dict[str, float]:
    """A network trained for a camera, and the best Wiener filter, on scenes of unseen images."""
    camera = optics.camera(base)
    lessons = Lessons(source, SCENES, batch=2, pool=200)
    network = RefocusNetwork(untrained(camera), Planes(camera), OPTIONS)
    options = TrainingOptions(steps=steps, rate=1e-3, check_every=max(1, steps // 5))
    network = train(network, lessons, options).model
    batch = draw_batch(jax.random.key(77), drawn(9, 16, 64).images, camera, SCENES, 48)
    found = read(network, batch.capture, batch.commanded[:, None], batch.deviation).images[:, 0]
    strengths = [
        quality(wiener_images(network.planes, batch, jnp.float32(s)), batch.image)
        for s in (0.1, 0.3, 1.0, 3.0)
    ]
    return {"network": quality(found, batch.image), "Wiener": max(strengths)}


def quality(images, targets) -> float:
    return float(np.mean([scores(i, t)["psnr"] for i, t in zip(images, targets, strict=True)]))


def main(steps: int) -> None:
    base, source = base_camera(), drawn(0, 32, 64)
    images = jnp.asarray(source.images)
    start = Optics.create(*START)
    strength = jnp.zeros((), jnp.float32)
    designs = {
        "start": start,
        "for Wiener": found_optics(base, images, (start, strength), wiener_loss, steps),
        "with the network": found_optics(
            base, images, (start, untrained(base)), network_loss, steps
        ),
    }
    print("| design | β (rad/mm²) | d (mm) | network (dB) | Wiener (dB) |\n|---|---|---|---|---|")
    for name, optics in designs.items():
        thin = optics.camera(base).camera
        found = judged(base, optics, source, 3 * steps)
        numbers = f"{float(thin.mask.beta):.2f} | {float(thin.distance):.2f}"
        scores = f"{found['network']:.2f} | {found['Wiener']:.2f}"
        print(f"| {name} | {numbers} | {scores} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 600)
