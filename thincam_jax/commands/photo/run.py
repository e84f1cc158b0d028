"""Working through captures: prepare, reconstruct, write, and say what was done."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax import measured
from thincam_jax._core.files import WriteError, writing
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.commands.doctor import environment
from thincam_jax.commands.photo.jobs import Job, write_job
from thincam_jax.commands.photo.options import Background, Output, Recipe, Sources
from thincam_jax.imaging.operators import window_shape
from thincam_jax.reconstruction import (
    InverseProblem,
    Progress,
    Psfs,
    Reconstruction,
    Recording,
    TotalVariation,
    choose_solver,
    reconstruct,
)
from thincam_jax.reconstruction.noise import estimate_noise, estimate_variance
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.recording import middle
from thincam_jax.reconstruction.regularised import AbstractRegularised

# Real arrays of the window's size that a reconstruction holds at its peak, for each channel.
_WINDOWS = 28

Told = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Finished:
    """A capture whose image is written, and the record that was written beside it."""

    job: Job
    record: dict[str, Any]
    image: Float[np.ndarray, "channel y x"]

    @property
    def status(self) -> str:
        """See `Reconstruction.ending`."""
        return self.record.get("reconstruction", {}).get("status", "")

    @property
    def learned(self) -> bool:
        """Whether a network made it."""
        return self.record["reconstruction"]["method"] == "learned"


@dataclass(frozen=True)
class Failed:
    """A capture of which nothing was written, and why: one line."""

    job: Job
    error: measured.MeasurementError | MemoryError | WriteError


def run_jobs(
    jobs: Sequence[Job], sources: Sources, recipe: Recipe, output: Output, told: Told | None = None
) -> Iterator[Finished | Failed]:
    """Reconstruct capture after capture; the files of one are written before the next begins.

    All captures of one shape are computed by what was compiled for the first. One that fails is
    given as `Failed`, and the next is taken up. `told` is called with the capture's name and the
    `Progress` of its iteration. Ctrl-C writes the best image so far, with the status "interrupted",
    and ends; before the first image is there, it raises KeyboardInterrupt.

    **Errors**: MeasurementError, one line, for sources that cannot be read.
    """
    rig, focused = Rig(sources), []
    for job in jobs:
        try:
            if job.focus is None:
                images, focused = focused, []
                finished = _join(job, images, rig, output)
            else:
                finished = _run_job(job, rig, recipe, output, told)
        except (measured.MeasurementError, MemoryError, WriteError) as error:
            yield Failed(job, error)
            continue
        if sources.distances and job.focus is not None:
            focused.append(finished.image)
        yield finished
        if finished.status == "interrupted":
            return


class Rig:
    """`Sources`, read once."""

    def __init__(self, sources: Sources):
        self.sources = sources
        psf_bits = sources.bits if sources.psf_bits is None else sources.psf_bits
        given = sources.psf
        if isinstance(given, measured.Raw):
            self.psfs = [given]
        elif sources.distances:
            self.psfs = measured.read_images(given, psf_bits)
            if len(self.psfs) != len(sources.distances):
                raise measured.MeasurementError(
                    f"{given}: holds {len(self.psfs)} PSFs for {len(sources.distances)} distances; "
                    "give one for each, nearest first"
                )
        else:
            self.psfs = [measured.read_image(given, psf_bits)]
        self.background = _background(sources.background, sources.bits)
        self.psf_background = _background(sources.psf_background, psf_bits)
        self.dead = None if sources.dead is None else measured.read_mask(sources.dead)

    def prepare(self, capture: Path, focus: int = 0) -> measured.Prepared:
        return measured.prepare(
            self.psfs[focus],
            measured.read_image(capture, self.sources.bits),
            self.background,
            self.sources.preparation,
            psf_background=self.psf_background,
            dead=self.dead,
        )


def _background(given: Background, bits: int | None) -> measured.Raw | float | None:
    return measured.read_image(given, bits) if isinstance(given, Path) else given


def _run_job(job: Job, rig: Rig, recipe: Recipe, output: Output, told: Told | None) -> Finished:
    began = time.perf_counter()
    ready = rig.prepare(job.capture, job.focus or 0)
    _check_channels(job, ready, recipe, output)
    beside = None
    if recipe.focusing is None:
        image, facts = _reconstruct(job, ready, recipe, told)
    else:
        from thincam_jax.commands.photo.network import focus

        noise, how = _noise(ready, recipe)
        image, facts, marked = focus(ready, recipe.focusing, noise)
        facts["noise"] = {"counts": noise / _of_a_count(ready), "found": how}
        image = image[:, ::-1, ::-1] if recipe.flip else image
        beside = dict.fromkeys(job.beside, marked)
    shown = {"gamma": output.gamma, "white_balance": output.white_balance}
    record = {
        "capture": job.capture,
        "sources": _told(rig.sources),
        "preparation": ready.log,
        "reconstruction": facts,
        "image": {
            "shape": image.shape,
            "field": recipe.field,
            "turned_by_180_degrees": recipe.flip,
            "minimum": image.min(),
            "maximum": image.max(),
        },
        "files": {path.suffix[1:].lower(): path.name for path in job.images},
        "display": shown if job.is_shown else None,
        "environment": environment(time.perf_counter() - began),
    }
    return _written(job, image, record, output, beside)


def _join(job: Job, images: list[np.ndarray], rig: Rig, output: Output) -> Finished:
    """The image that is sharp everywhere, with the depth map; of one image for each distance."""
    from thincam_jax.commands.photo.depth import draw_depth, find_depth

    began, distances = time.perf_counter(), rig.sources.distances
    if len(images) != len(distances):
        raise measured.MeasurementError(
            f"{job.images[0]}: is not made, nor a depth map: {len(images)} of {len(distances)} "
            "distances could be reconstructed"
        )
    sweep, depth, sharp = find_depth(images, distances)
    record = {
        "capture": job.capture,
        "sources": _told(rig.sources),
        "psfs": [psf.name for psf in rig.psfs],
        "files": [path.name for path in (*job.images, *job.beside)],
        "environment": environment(time.perf_counter() - began),
    }
    return _written(job, sharp, record, output, draw_depth(job, sweep, depth, sharp))


def _written(job: Job, image: np.ndarray, record, output: Output, beside=None) -> Finished:
    with writing(job.images[0]):
        write_job(job, image, record, output, beside)
    return Finished(job, record, image)


def _told(sources: Sources) -> dict[str, Any]:
    """All but the preparation, which tells its own."""
    names = ("background", "psf_background", "dead", "bits", "psf_bits")
    psf = sources.psf.name if isinstance(sources.psf, measured.Raw) else sources.psf
    told = {"psf": psf, **{name: getattr(sources, name) for name in names}}
    return told | ({"distances_mm": sources.distances} if sources.distances else {})


def _reconstruct(
    job: Job, ready: measured.Prepared, recipe: Recipe, told: Told | None
) -> tuple[Float[np.ndarray, "channel y x"], dict[str, Any]]:
    """The image, and what was done for it."""
    # The mask is given even where all is valid, so that one compilation serves a whole folder.
    capture, psf, valid = (jnp.asarray(a)[None] for a in (ready.capture, ready.psf, ready.valid))
    *_, channels, rows, columns = capture.shape  # those of the PSF as well
    sensor, field = (rows, columns), (2 * rows - 1, 2 * columns - 1)
    window = window_shape(sensor, field, sensor)
    refuse_if_too_large(
        f"{job.capture}: its reconstruction on {window[0]}×{window[1]} samples",
        4 * _WINDOWS * channels * window[0] * window[1],
        "give a larger downsample",
    )
    noise, how = _noise(ready, recipe)
    seen_by = Psfs(psf, field_shape=field)
    recording = Recording(capture, seen_by, valid=valid, noise_variance=noise**2)
    solver = recipe.solver(channels)
    # Conjugate gradients run in one piece: there is nothing to tell of before the end.
    callback = None if told is None or recipe.is_ridge else partial(told, job.name)
    found = reconstruct(recording, solver, callback=callback)
    if found.status == "non_finite":
        weight = (
            ("ridge", recipe.relative_ridge) if recipe.is_ridge else ("tau", recipe.relative_tau)
        )
        raise measured.MeasurementError(
            f"{job.capture}: the image became NaN or infinite after {found.iterations} iterations; "
            f"give a {weight[0]} (now {weight[1]:g}) that is nearer to 1"
        )
    if found.status == "interrupted" and not found.iterations:
        raise KeyboardInterrupt
    problem = recording.problem(
        tau=recipe.relative_tau,
        regulariser=solver.prior if isinstance(solver, AbstractRegularised) else None,
    )
    image = found.image if recipe.field == "full" else middle(found.image, sensor)
    image = np.asarray(image, dtype=np.float32)
    facts = _facts(recording, found, problem, recipe)
    facts["noise"] = {"counts": noise / _of_a_count(ready), "found": how}
    return image[:, ::-1, ::-1] if recipe.flip else image, facts


def _noise(ready: measured.Prepared, recipe: Recipe) -> tuple[float, str]:
    """Standard deviation of a prepared pixel's noise, and how it was found."""
    if recipe.noise is not None:
        return recipe.noise * _of_a_count(ready), "given"
    how = "estimated from the finest detail at each brightness"
    light, valid = (jnp.asarray(array) for array in (ready.capture, ready.valid))
    if ready.log["demosaicing"]["method"] == "bilinear":
        # Neighbours share their noise. Every second pixel has its own; where a colour was measured
        # it has the most.
        parts = [np.s_[:, i::2, j::2] for i in range(2) for j in range(2)]
        each = jnp.stack([estimate_noise(light[part], valid[part]) for part in parts])
        noise = float(jnp.sqrt(jnp.mean(jnp.max(each, axis=0) ** 2)))
        if noise > 0:
            return noise, f"{how}, in every second pixel of each colour"
    return float(jnp.sqrt(estimate_variance([light], [valid])[0])), how


def _of_a_count(ready: measured.Prepared) -> float:
    """What a raw pixel's standard deviation of one count is in the prepared capture."""
    log = ready.log
    full_scale = log["full_scale"]["capture"]["full_scale"]
    return 1 / (full_scale * log["downsampling"]["factor"] * log["scaling"]["capture_divisor"])


def _facts(
    recording: Recording, found: Reconstruction, problem: InverseProblem, recipe: Recipe
) -> dict[str, Any]:
    is_ridge, prior = recipe.is_ridge, problem.regulariser
    assert isinstance(prior, TotalVariation)
    variation = {"kind": prior.kind, "coupling": prior.coupling}
    return {
        "method": found.method,
        "asked_for": recipe.method,
        "reason": choose_solver(recording)[1] if recipe.method == "auto" else "",
        "tau": None if is_ridge else recipe.relative_tau,
        "absolute_tau": None if is_ridge else problem.absolute_tau,
        "ridge": recipe.relative_ridge if is_ridge else None,
        # The weight of a trusted pixel is 1/σ².
        "noise_standard_deviation": 1 / jnp.sqrt(jnp.max(problem.weights[0])),
        "variation": None if is_ridge else variation,
        "nonnegative": problem.nonnegative and not is_ridge,
        "field_shape": problem.field_shape,
        "iterations_at_most": recipe.iterations,
        "iterations": found.iterations,
        "status": found.status,
        "relative_data_residual": _relative_residual(problem, found.image[:, None]),
        "history": [asdict(step) for step in found.history],
        "seconds": round(found.seconds, 3),
    }


@jax.jit
def _relative_residual(
    problem: InverseProblem, image: Float[Array, "channel plane y x"]
) -> Float[Array, ""]:
    """‖Hf − g‖/‖g‖ over the pixels that are trusted."""
    (missing,), (capture,), (weight,) = residuals(problem, image), problem.captures, problem.weights
    trusted = weight > 0
    return jnp.linalg.norm(jnp.where(trusted, missing, 0)) / jnp.linalg.norm(
        jnp.where(trusted, capture, 0)
    )


def _check_channels(job: Job, ready: measured.Prepared, recipe: Recipe, output: Output) -> None:
    """What would else be noticed when the work is done."""
    channels = ready.capture.shape[0]
    if recipe.coupling == "opponent" and channels != 3:
        raise measured.MeasurementError(
            f"{job.capture}: has {channels} channels and coupling 'opponent' is for 3; "
            "choose 'joint' or 'none'"
        )
    if job.is_shown:
        if channels not in (1, 3):
            raise measured.MeasurementError(
                f"{job.capture}: has {channels} channels and a PNG shows 1 or 3; give an output "
                "with the suffix .npy or .tif"
            )
        measured.to_display(
            np.ones((channels, 1, 1)), white_balance=output.white_balance, gamma=output.gamma
        )
    if not (ready.valid & (ready.capture > 0)).any(axis=(1, 2)).all():
        raise measured.MeasurementError(
            f"{job.capture}: has a channel without a trusted pixel that holds light; all others "
            "are saturated or dead: give a larger saturation, or expose less"
        )
