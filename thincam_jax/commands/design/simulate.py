"""The reference and the found designs in the full simulation, with noise from several seeds."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import MethodConfig, StudyConfig, TargetConfig
from thincam_jax.commands.study.evaluate import evaluate
from thincam_jax.imaging.scene import ImagePlane

Trials = dict[str, list[dict[str, Any]]]  # by method, the metrics of each seed


def simulate(study: StudyConfig, index: int, target: TargetConfig, seeds: int) -> Trials:
    """Every method on one target; captures without noise are computed once.

    The first seed is the study's own, so that `thincam run` gives the same.
    """
    plane = build.build_plane(study, target)
    clean: dict[build.Setting, Any] = {}
    trials: Trials = {}
    for number, method in enumerate(study.methods):
        used = build.settings(study, method)
        for setting in used:
            if setting not in clean:
                camera = build.build_camera(study, setting)
                clean[setting] = build.imaging(study, camera, setting, plane)
        trials[method.name] = _method(study, index, target, plane, method, clean, seeds)
        later = {s for m in study.methods[number + 1 :] for s in build.settings(study, m)}
        clean = {s: image for s, image in clean.items() if s in later}
    return trials


def _method(
    study: StudyConfig,
    index: int,
    target: TargetConfig,
    plane: ImagePlane,
    method: MethodConfig,
    clean: dict[build.Setting, Any],
    seeds: int,
) -> list[dict[str, Any]]:
    shape = build.field_shape(study, method, plane)
    reconstructor = build.build_reconstructor(study, method, shape)
    places = {setting: n for n, setting in enumerate(build.all_settings(study))}
    metrics = []
    for trial in range(seeds):
        seeded = study.model_copy(update={"seed": (study.seed + trial) % 2**32})
        exposures = [
            build.expose(
                seeded,
                build.build_camera(study, s),
                clean[s],
                build.capture_key(seeded, index, places[s]),
            )
            for s in build.settings(study, method)
        ]
        reconstruction = reconstructor(
            jnp.asarray(np.stack([e.image for e in exposures])),
            jnp.asarray(np.stack([e.variance for e in exposures])),
        )
        metrics.append(evaluate(study, method, target, plane, reconstruction).metrics)
    return metrics
