"""Training a refocusing network in a folder, and a report of what it gives."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.learned import figures, report
from thincam_jax.commands.learned.build import build_lessons, build_network, build_options
from thincam_jax.commands.learned.config import LearnedConfig
from thincam_jax.commands.refocus.figures import animate_sweep, draw_sweep
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.figures import save_figure
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.learn.checkpoint import CheckpointError
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.scenes import Batch
from thincam_jax.learn.refocusing.train import NETWORK, Lessons, train
from thincam_jax.learn.refocusing.unet import parameter_count
from thincam_jax.learn.refocusing.use import Reading, read
from thincam_jax.learn.training import Trained, TrainingProgress
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, refocus_distances

_SWEPT = 15  # distances of the report's sweep


class TrainingFolder(RunFolder):
    """Files of one training, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `network.thincam`: the best network until now; `training-1.state` and so on: what
      `--resume` goes on from.
    - `figures/`, `environment.json`, `report.html` and, last, `training.json`.
    """

    kind, folders, result = "training", ("figures",), "training.json"
    others = (NETWORK,)


def run_training(
    config: LearnedConfig,
    folder: TrainingFolder,
    callback: Callable[[TrainingProgress], object],
    *,
    resume: bool = False,
) -> dict[str, Any]:
    """Train and report; returns (and writes) what goes into training.json.

    `resume`: go on from the state in the folder, to the same bits as without the interruption.

    **Errors**: ConfigError where a folder holds a training and `resume` is not asked for, or the
    other way round, or holds a damaged state.
    """
    started = time.time()
    check_resume(folder, resume)
    network, lessons = build_network(config), build_lessons(config)
    folder.claim(config)
    try:
        options = build_options(config)
        trained = train(network, lessons, options, folder=folder.path, callback=callback)
    except CheckpointError as error:
        raise ConfigError(str(error)) from None
    return _report(config, folder, lessons, network, trained, started)


def check_resume(folder: TrainingFolder, resume: bool) -> None:
    """**Errors**: ConfigError where the folder has a state and `resume` is not asked for, or the
    other way round."""
    begun = any(folder.path.glob("training*.state"))
    if begun and not resume:
        raise ConfigError(
            f"--out {folder.path}: holds a training; give --resume to go on with it, or another "
            "folder"
        )
    if resume and not begun:
        raise ConfigError(f"--resume: {folder.path} holds no training yet; leave it out")


def _report(
    config: LearnedConfig,
    folder: TrainingFolder,
    lessons: Lessons,
    untrained: RefocusNetwork,
    trained: Trained,
    started: float,
) -> dict[str, Any]:
    network, state = trained.model, trained.state
    batches = lessons.validation(network, config.seed)
    linear, readings = ([read_batch(n, b) for b in batches] for n in (untrained, network))
    result = {
        "name": config.name,
        "kind": config.kind,
        "seed": config.seed,
        "status": trained.status,
        **state.counts,
        "losses": [_rounded(loss) for loss in state.losses],
        "scores": [_rounded(score) for score in state.scores],
        "learned_numbers": parameter_count(network.weights),
        "linear": score(linear, batches),
        "trained": score(readings, batches),
        "images": lessons.manifest()["images"],
        "network": NETWORK,
    }
    save_figure(folder, "loss", figures.draw_losses(state, config.training.check_every))
    save_figure(folder, "scenes", figures.draw_scenes(network, batches[0], readings[0]))
    sweep = swept(network, batches[0])
    save_figure(folder, "sweep", draw_sweep(sweep, {}))
    folder.write("figures/sweep.webp", animate_sweep(sweep))
    folder.complete(report.page(config, result), config, result, started)
    return result


def read_batch(network: RefocusNetwork, batch: Batch) -> Reading:
    """Each capture of a batch, focused on the distance that is commanded for it."""
    return read(network, batch.capture, batch.commanded[:, None], batch.deviation)


def score(readings: Sequence[Reading], batches: Sequence[Batch]) -> dict[str, Any]:
    """Mean PSNR and SSIM of focused images and of those sharp everywhere, and the consistency."""
    found: dict[str, list[float]] = {}
    for reading, batch in zip(readings, batches, strict=True):
        pairs = {
            "focus": (reading.images[:, 0], batch.image),
            "all_in_focus": (reading.all_in_focus, batch.all_in_focus),
        }
        for name, (images, truths) in pairs.items():
            for image, truth in zip(np.asarray(images), np.asarray(truths), strict=True):
                arrays = image.astype(float), truth.astype(float)
                found.setdefault(f"{name}_psnr_db", []).append(float(psnr(*arrays)))
                found.setdefault(f"{name}_ssim", []).append(float(ssim(*arrays)))
        found.setdefault("consistency", []).extend(np.asarray(reading.consistency).tolist())
    return {name: _rounded(np.mean(values)) for name, values in found.items()}


def swept(network: RefocusNetwork, batch: Batch) -> RefocusSweep:
    """The first capture of a batch, focused on distances even in 1/t, upright."""
    camera, size = network.camera, len(batch.capture)
    distances = refocus_distances(float(camera.near), float(camera.far), _SWEPT)
    first = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), batch)
    # As many at a time as the batch has, which is compiled for.
    rounds = np.resize(np.asarray(distances), (-(-_SWEPT // size), size))
    images = [read_batch(network, replace(first, commanded=jnp.asarray(t))) for t in rounds]
    images = jnp.concatenate([found.images[:, 0] for found in images])[:_SWEPT, ::-1, ::-1]
    slope = camera.camera.sensor.pitch / camera.camera.distance
    return RefocusSweep(images, jnp.asarray(distances, images.dtype), slope, "learned")


def _rounded(value: Any) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
