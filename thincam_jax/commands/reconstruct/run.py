"""Reconstruct captures from their files: prepare, reconstruct, write, and record what was done."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax import measured
from thincam_jax._core.environment import environment
from thincam_jax._core.files import WriteError, writing
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.commands.reconstruct.jobs import Job, write_job
from thincam_jax.commands.reconstruct.options import Background, Output, Recipe, Sources
from thincam_jax.imaging.operators import window_shape
from thincam_jax.measured.write import linear_bytes
from thincam_jax.reconstruction import (
    InverseProblem,
    Progress,
    Psfs,
    Reconstruction,
    Recording,
    TotalVariation,
    check_psf,
    choose_solver,
    reconstruct,
)
from thincam_jax.reconstruction.depth import depth_of_colours
from thincam_jax.reconstruction.methods import AbstractRegularised
from thincam_jax.reconstruction.noise import demosaiced_noise, estimate_variance
from thincam_jax.reconstruction.problem import relative_residual
from thincam_jax.reconstruction.recording import centred_crop

# Real arrays of the window's size that a reconstruction holds at its peak, for each channel.
_WINDOWS = 28
_SIDE = 160  # pixels of the longer side, about: enough for half a per cent of scale

Report = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Finished:
    """A capture whose image was written, and the record beside it."""

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
    """A capture of which nothing was written, with the error of one line."""

    job: Job
    error: measured.MeasurementError | MemoryError | WriteError


def run_jobs(
    jobs: Sequence[Job],
    sources: Sources,
    recipe: Recipe,
    output: Output,
    report: Report | None = None,
) -> Iterator[Finished | Failed]:
    """Reconstruct capture after capture; the files of one are written before the next begins.

    Captures of one shape are compiled once. One that fails is returned as `Failed`, and the next is
    reconstructed. `report` is called with the capture's name and the
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
                finished = _run_job(job, rig, recipe, output, report)
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


def _run_job(job: Job, rig: Rig, recipe: Recipe, output: Output, report: Report | None) -> Finished:
    began = time.perf_counter()
    ready = rig.prepare(job.capture, job.focus or 0)
    _check_channels(job, ready, recipe, output)
    beside = None
    if recipe.focusing is None:
        image, facts = _reconstruct(job, ready, recipe, report)
    else:
        from thincam_jax.commands.reconstruct.network import focus

        noise, how = _noise(ready, recipe)
        image, facts, marked = focus(ready, recipe.focusing, noise)
        facts["noise"] = {"counts": noise / _of_a_count(ready), "found": how}
        image = image[:, ::-1, ::-1] if recipe.flip else image
        beside = dict.fromkeys(job.beside, marked)
    shown = {"gamma": output.gamma, "white_balance": output.white_balance}
    record = {
        "capture": job.capture,
        "sources": _source_facts(rig.sources),
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
    from thincam_jax.commands.refocus import figures
    from thincam_jax.commands.study.figures import as_png

    began, distances = time.perf_counter(), rig.sources.distances
    if len(images) != len(distances):
        raise measured.MeasurementError(
            f"{job.images[0]}: is not made, nor a depth map: {len(images)} of {len(distances)} "
            "distances could be reconstructed"
        )
    sweep, depth, sharp = depth_of_colours(jnp.stack(images), distances)
    sharp, distance = np.asarray(sharp), np.asarray(depth.distance, np.float32)[None]
    sheet, map_, *linear = job.beside
    beside = {
        sheet: as_png(figures.draw_sweep(sweep, {})),
        map_: as_png(figures.draw_depth(sweep, depth, sharp.mean(axis=0))),
    } | {path: linear_bytes(distance, path.suffix.lower()) for path in linear}
    record = {
        "capture": job.capture,
        "sources": _source_facts(rig.sources),
        "psfs": [psf.name for psf in rig.psfs],
        "files": [path.name for path in (*job.images, *job.beside)],
        "environment": environment(time.perf_counter() - began),
    }
    return _written(job, sharp, record, output, beside)


def _written(job: Job, image: np.ndarray, record, output: Output, beside=None) -> Finished:
    with writing(job.images[0]):
        write_job(job, image, record, output, beside)
    return Finished(job, record, image)


def _source_facts(sources: Sources) -> dict[str, Any]:
    """Facts of the sources, without those of the preparation."""
    names = ("background", "psf_background", "dead", "bits", "psf_bits")
    psf = sources.psf.name if isinstance(sources.psf, measured.Raw) else sources.psf
    facts = {"psf": psf, **{name: getattr(sources, name) for name in names}}
    return facts | ({"distances_mm": sources.distances} if sources.distances else {})


def _reconstruct(
    job: Job, ready: measured.Prepared, recipe: Recipe, report: Report | None
) -> tuple[Float[np.ndarray, "channel y x"], dict[str, Any]]:
    """The image, and the facts of its reconstruction."""
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
    psfs = Psfs(psf, field_shape=field)
    recording = Recording(capture, psfs, valid=valid, noise_variance=noise**2)
    solver = recipe.solver(channels)
    # Conjugate gradients are one compiled program, without progress.
    callback = None if report is None or recipe.is_ridge else partial(report, job.name)
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
    image = found.image if recipe.field == "full" else centred_crop(found.image, sensor)
    image = np.asarray(image, dtype=np.float32)
    facts = _facts(recording, found, problem, recipe)
    facts["noise"] = {"counts": noise / _of_a_count(ready), "found": how}
    return image[:, ::-1, ::-1] if recipe.flip else image, facts


def _noise(ready: measured.Prepared, recipe: Recipe) -> tuple[float, str]:
    """Standard deviation of a prepared pixel's noise, and how it was obtained."""
    if recipe.noise is not None:
        return recipe.noise * _of_a_count(ready), "given"
    how = "estimated from the finest detail at each brightness"
    light, valid = (jnp.asarray(array) for array in (ready.capture, ready.valid))
    if ready.log["demosaicing"]["method"] == "bilinear":
        noise = float(demosaiced_noise(light, valid))
        if noise > 0:
            return noise, f"{how}, in every second pixel of each colour"
    return float(jnp.sqrt(estimate_variance([light], [valid])[0])), how


def _of_a_count(ready: measured.Prepared) -> float:
    """One count of a raw pixel in units of the prepared capture."""
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
        "relative_data_residual": relative_residual(problem, found.image[:, None]),
        "history": [asdict(step) for step in found.history],
        "seconds": round(found.seconds, 3),
    }


def _check_channels(job: Job, ready: measured.Prepared, recipe: Recipe, output: Output) -> None:
    """Refuse what would otherwise fail after the reconstruction."""
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


def check_files(
    sources: Sources, capture: Path, search: float, report: Callable[[int, int], object]
) -> tuple[list[str], bool]:
    """The lines that report `check_psf` of two files, and whether the PSF fits."""
    rig = Rig(sources)
    ready = rig.prepare(capture)
    shape = ready.capture.shape[-2:]
    recording = Recording(
        jnp.asarray(ready.capture)[None],
        Psfs(jnp.asarray(ready.psf)[None]),
        valid=jnp.asarray(ready.valid)[None],
    )
    try:
        found = check_psf(recording, search=search, callback=report)
    except ValueError as error:
        raise measured.MeasurementError(str(error)) from None
    size = f"{shape[0]}×{shape[1]} pixels, blocks of {sources.preparation.downsample}"
    lines = [
        f"{sources.psf} with {capture} at {size}:",
        f"residual {found.noise_ratio:.2f} times the noise, best scale "
        f"{found.scale:.4f} ± {found.scale_error:.4f}",
    ]
    return lines + [f"your PSF is wrong: {reason}" for reason in found.reasons] + (
        ["your PSF fits best as it is"] if found.fits else []
    ), found.fits


def enough_blocks(sources: Sources) -> Sources:
    """The sources with a `downsample` that leaves about 160 pixels of the longer side."""
    halved = sources.preparation.demosaicing == "superpixel" and sources.preparation.bayer
    pixels = max(Rig(sources).psfs[0].pixels.shape[:2]) // (2 if halved else 1)
    preparation = replace(sources.preparation, downsample=max(1, round(pixels / _SIDE)))
    return replace(sources, preparation=preparation)
