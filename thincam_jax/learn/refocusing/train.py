"""Training of a refocusing network on drawn scenes, in a folder that it goes on from."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.loss import loss
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.scenes import Batch, SceneOptions, draw_batch
from thincam_jax.learn.refocusing.sources import Source
from thincam_jax.learn.refocusing.store import described, save
from thincam_jax.learn.training import (
    Task,
    Trained,
    TrainingOptions,
    TrainingProgress,
    TrainingState,
    read_state,
    train_model,
    write_state,
)

NETWORK, STATE = "network.thincam", "training.state"
# Of the seed's key: examples of training have the numbers of their steps.
_JUDGED = 2**31


class Lessons(NamedTuple):
    """What a network is trained on.

    - `source`: the images; `scenes`: what is drawn of them.
    - `batch`: scenes of a step. `judged`: batches that judge the network at each check, drawn of
      `held_out` images, which no step sees; by default of the same.
    """

    source: Source
    scenes: SceneOptions = SceneOptions()
    batch: int = 4
    judged: int = 4
    held_out: Source | None = None

    def task(self, network: RefocusNetwork, seed: int) -> Task:
        """Of the camera of a network."""
        images = jnp.asarray(self.source.images)
        drawn = _Drawn(images, network.camera, self.scenes, self.batch)
        unseen = images if self.held_out is None else jnp.asarray(self.held_out.images)
        judge, key = drawn._replace(images=unseen), jax.random.key(seed)
        keys = [jax.random.fold_in(key, _JUDGED + n) for n in range(self.judged)]
        nothing = jax.tree.map(lambda _: False, network)
        learned = eqx.tree_at(lambda n: n.weights, nothing, True)
        return Task(drawn.draw, loss, [judge.draw(k) for k in keys], learned)

    def manifest(self) -> dict[str, Any]:
        """The images as JSON, with their sums and licences; and how scenes are drawn."""
        sources = {"trained on": self.source, "judged on": self.held_out}
        return {
            "images": {
                use: [entry._asdict() for entry in source.manifest]
                for use, source in sources.items()
                if source is not None
            },
            "scenes": self.scenes._asdict(),
            "batch": self.batch,
            "judged": self.judged,
        }


class _Drawn(NamedTuple):
    images: jax.Array
    camera: RefocusCamera
    scenes: SceneOptions
    size: int

    def draw(self, key) -> Batch:
        return draw_batch(key, self.images, self.camera, self.scenes, self.size)


def train(
    network: RefocusNetwork,
    lessons: Lessons,
    options: TrainingOptions,
    *,
    folder: str | os.PathLike[str] | None = None,
    callback: Callable[[TrainingProgress], object] | None = None,
) -> Trained:
    """Train a network; see `thincam_jax.learn.training.train_model`.

    **Arguments**

    - `folder`: holds `network.thincam`, the best until now, and `training.state`; both are written
      at each check, whole or not at all. Training goes on from a state that is there, and ends with
      the same bits as without the interruption, on one machine.

    **Errors**: CheckpointError, one line, for a state that is damaged or of another training.
    """
    task = lessons.task(network, options.seed)
    told = {**lessons.manifest(), "training": dataclasses.asdict(options)}
    state = begun = TrainingState.begin(network, task, options)
    if folder is None:
        return train_model(task, network, options, callback=callback)
    folder = Path(folder)
    settings = {
        "camera": described(network.camera),
        "options": network.options._asdict(),
        **told,
    }
    if (folder / STATE).exists():
        state = read_state(folder / STATE, begun, settings)

    def keep(state: TrainingState) -> None:
        best = eqx.combine(state.best, network)
        scores = [float(score) for score in state.scores if score == score]
        numbers = {"steps": state.step, "skipped": state.skipped, "retreats": state.retreats}
        save(folder / NETWORK, best, {**told, "scores": scores, **numbers})
        # Last: it is what training goes on from.
        write_state(folder / STATE, state, settings)

    return train_model(task, network, options, state=state, keep=keep, callback=callback)
