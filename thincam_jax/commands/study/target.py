"""One target through every method: captures, reconstructions and how good they are."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import StudyConfig, TargetConfig
from thincam_jax.commands.study.evaluate import Evaluation, evaluate

Progress = Callable[[str], None]


class Examined(NamedTuple):
    """The first capture (channel, y, x) of a target, and each method's evaluation by its name."""

    capture: np.ndarray
    evaluations: dict[str, Evaluation]


def examine_target(
    config: StudyConfig,
    index: int,
    target: TargetConfig,
    reconstructors: dict[tuple, Callable],
    progress: Progress,
) -> Examined:
    """Take the captures that the methods share, once, and evaluate every method on them.

    `index` is the target's place in the study, on which its noise depends; `reconstructors` holds
    those that earlier targets of the same study have built, and takes new ones.
    """
    plane = build.build_plane(config, target)
    captures: dict[build.Setting, build.Exposure] = {}
    for number, setting in enumerate(build.all_settings(config)):
        progress(f"{target.name}: capture {number + 1}")
        key = build.capture_key(config, index, number)
        captures[setting] = build.take(config, setting, plane, key)
    evaluations: dict[str, Evaluation] = {}
    for method in config.methods:
        progress(f"{target.name}: {method.name}")
        shape = build.field_shape(config, method, plane)
        reconstructor = reconstructors.get((method.name, shape))
        if reconstructor is None:
            reconstructor = build.build_reconstructor(config, method, shape)
            reconstructors[method.name, shape] = reconstructor
        used = [captures[s] for s in build.settings(config, method)]
        reconstruction = reconstructor(
            jnp.asarray(np.stack([exposure.image for exposure in used])),
            jnp.asarray(np.stack([exposure.variance for exposure in used])),
        )
        evaluations[method.name] = evaluate(config, method, target, plane, reconstruction)
    return Examined(captures[build.all_settings(config)[0]].image, evaluations)


def mean_psnr_of_pictures(config: StudyConfig, psnr_db: dict[str, float | None]) -> float | None:
    """The mean over photographs and files, dB, from the PSNR by target; None without any.

    Drawn targets are left out, and exact reconstructions, which have no PSNR.
    """
    pictures = [psnr_db[t.name] for t in config.targets if t.kind in ("photograph", "file")]
    known = [value for value in pictures if value is not None]
    return round(float(np.mean(known)), 4) if known else None
