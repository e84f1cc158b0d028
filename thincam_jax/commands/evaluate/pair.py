"""One pair of a data set, reconstructed and scored: the work of a worker process."""

import functools
import json
import traceback
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax._core.environment import installed
from thincam_jax._core.files import file_digest
from thincam_jax._core.precision import double_precision
from thincam_jax.commands.evaluate.config import EvaluationConfig
from thincam_jax.commands.reconstruct.jobs import Inputs
from thincam_jax.commands.reconstruct.options import is_trained
from thincam_jax.commands.run_folder import digest
from thincam_jax.commands.sweep.point import one_line
from thincam_jax.measured import MeasurementError, Raw
from thincam_jax.measured.examination import Examination, examine
from thincam_jax.measured.merging import without_hot_pixels
from thincam_jax.measured.pairs import PairedCapture, Pairs, relative_pitch
from thincam_jax.measured.preparation import Prepared
from thincam_jax.studies.agreement import Agreement, agreement
from thincam_jax.studies.intervals import Levels, PixelSample
from thincam_jax.studies.prepared import check_channels, pixel_noise, reconstruct_prepared

# Part of every key: to be raised when the same files and options are to give other scores.
SCORES_VERSION = 2
_PIXELS = 256  # of a picture, by which intervals are calibrated


@dataclass(frozen=True, eq=False)
class Scored:
    """Scores of a pair by a method; or why there are none, in one line.

    - `key`: digest of all that they depend on.
    - `scores`: numbers by name, and findings. `seconds`: time of the reconstruction.
    - `shown`: capture, image and truth (channel, y, x), where they were asked for.
    """

    key: str
    scores: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    reason: str | None = None
    traceback: str | None = None
    shown: dict[str, np.ndarray] = field(default_factory=dict)


def score_pair(
    config: str, method: str, number: int, double: bool, with_images: bool = False
) -> Scored:
    """Scores of a pair; `config`: an `EvaluationConfig` as JSON. An error is an outcome, too."""
    key = ""
    try:
        with double_precision(double), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            _, pairs = opened(config)
            key = key_of(config, method, number, double)
            pair = pairs[number]
            found, seconds, others = reconstructed(config, method, pair)
    except (MeasurementError, MemoryError, OSError) as error:
        return Scored(key, reason="; ".join(str(error).splitlines()))
    except Exception as error:  # the others go on without a pair that shows a defect
        return Scored(key, reason=one_line(error), traceback=traceback.format_exc())
    scores = asdict(found) | others
    scores["findings"] += [str(one.message) for one in warned]
    image, truth = scores.pop("image"), scores.pop("truth")
    if not with_images:
        return Scored(key, scores, seconds)
    light = np.moveaxis(np.atleast_3d(pair.capture.pixels), -1, 0).astype(np.float32)
    if pairs.alignment.turned:
        light = light[:, ::-1, ::-1]
    light = light[:, ::-1] if pairs.alignment.upside_down else light
    shown = {"capture": light, "image": image, "truth": truth}
    return Scored(key, scores, seconds, shown=shown)


def reconstructed(
    config: str, method: str, pair: PairedCapture
) -> tuple[Agreement, float, dict[str, Any]]:
    """Agreement, seconds and further results, by the steps of `thincam reconstruct`."""
    asked, pairs = opened(config)
    recipe, (ready, examined) = asked.recipe(method), prepared_pair(config, pair)
    if bad := [str(one) for one in examined.findings if recipe.strict and one.severe]:
        raise MeasurementError(f"{bad[0]} (an error by --strict)")
    noise = pixel_noise(ready, recipe.noise)
    done = reconstruct_prepared(ready, recipe.solver(len(ready.capture)), noise, name=pair.name)
    if done.found.status == "non_finite":
        raise MeasurementError(f"{pair.name}: the image became NaN or infinite")
    both = pairs.alignment.matched(done.image(), pair.truth, ready.log)
    found = agreement(*both, fit=asked.fit, shift=asked.shift)
    levels: Levels = "own" if asked.fit == "levels" else "common"
    pixels = PixelSample.of(*both, _PIXELS, levels).as_lists()
    others = {"residual": done.relative_residual, "status": done.found.status, "pixels": pixels}
    findings = [str(one) for one in (*examined.findings, done.found.reason) if str(one)]
    return found, done.found.seconds, {**others, "findings": findings}


def prepared_pair(config: str, pair: PairedCapture) -> tuple[Prepared, Examination]:
    """Capture and PSF of a pair as a reconstruction takes them, and what was found in them."""
    capture = pair.capture
    scale = None if pair.psf is None else relative_pitch(pair.psf, capture)
    rig = _rig(config, pair.mask_label, scale)
    level: Any = pair.background or rig.background
    if isinstance(level, Raw):
        capture, level = without_hot_pixels(capture, level)
    examined = examine([capture], rig.psfs[0], rig.sources.preparation)
    ready = rig.ready(examined, level)
    check_channels(ready, pair.name)
    return ready, examined


def key_of(config: str, method: str, number: int, double: bool) -> str:
    """Digest of files, options, package and precision of a pair's scores."""
    _, pairs = opened(config)
    method = file_digest(Path(method)) if is_trained(method) else method
    origin = [SCORES_VERSION, _shared_origin(config), method, double, pairs.digest(number)]
    return digest(json.dumps(origin))


@functools.lru_cache(2)
def opened(config: str) -> tuple[EvaluationConfig, Pairs]:
    asked = EvaluationConfig.model_validate_json(config)
    return asked, asked.pairs()


@functools.lru_cache(2)
def _shared_origin(config: str) -> list[Any]:
    """Origin that all pairs share: options, package, PSFs and further files."""
    asked, pairs = opened(config)
    named = (asked.background, asked.psf_background, asked.dead)
    files = [*pairs.psfs.values(), *(Path(file) for file in named if file)]
    sums = [file_digest(file) for file in files if file.is_file()]
    # Files count by their content: a data set may be moved.
    paths = {"name", "title", "path", "split", "psf", "background", "psf_background", "dead"}
    texts = [None if not text or Path(text).is_file() else text for text in named[:2]]
    options = asked.model_dump_json(exclude=paths)
    return [options, texts, str(pairs.alignment), installed(("thincam_jax",)), sums]


@functools.lru_cache(4)
def _rig(config: str, label: int | None, psf_scale: float | None) -> Inputs:
    """The PSF of a mask, and what is subtracted."""
    asked, pairs = opened(config)
    psf = pairs.psf_file(label)
    if psf is None:
        raise MeasurementError(f"mask {label} has no PSF; name one {label} in the folder of --psf")
    return Inputs(asked.sources(psf, psf_scale))
