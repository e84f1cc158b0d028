"""Reconstruct captures from their files: prepare, reconstruct, write, and record what was done."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rich.progress

from thincam_jax import measured
from thincam_jax._core.environment import environment
from thincam_jax._core.files import WriteError
from thincam_jax._core.text import escaped
from thincam_jax.commands import terminal
from thincam_jax.commands.reconstruct.jobs import Inputs, Job, write_job
from thincam_jax.commands.reconstruct.options import Output, Recipe, Sources, is_trained, read_as
from thincam_jax.commands.terminal import (
    INTERRUPTED,
    WRONG_INPUT,
    in_a_line,
    progress_bar,
    say_result,
    tell,
)
from thincam_jax.measured.examination import Finding, finding
from thincam_jax.measured.preparation import Prepared
from thincam_jax.measured.write import LINEAR, linear_bytes
from thincam_jax.reconstruction import TotalVariation
from thincam_jax.reconstruction.depth.find import depth_of_colours
from thincam_jax.reconstruction.iterate import Progress
from thincam_jax.reconstruction.methods import choose_solver
from thincam_jax.reconstruction.other_psf import NEGATIVE, RESIZE, TURN
from thincam_jax.reconstruction.psf_check import blocks_blur, check_psf
from thincam_jax.reconstruction.refinement import changed_psf, refine
from thincam_jax.reconstruction.regularised import AbstractRegularised
from thincam_jax.studies.prepared import (
    PixelNoise,
    PreparedResult,
    check_channels,
    pixel_noise,
    prepared_recording,
    reconstruct_prepared,
)

_SIDE = 160  # pixels of the longer side, about: enough for half a per cent of scale
_UNEXPLAINED = 0.9  # of the capture's norm
_SUSPECT = 0.3  # of the capture's variation
_BRIGHTEST = 0.8  # of full scale, of a PSF that is written: it has not saturated

Report = Callable[[str, Progress], None]


@dataclass(frozen=True)
class Finished:
    """A capture whose image (channel, y, x) was written, and the record beside it.

    - `line`: a line that says what was done. `doubt`: fault with an image that does not explain
      its capture, or nothing.
    - `status`: see `Reconstruction.status`.
    - `findings`: faults that residual and noise show.
    """

    job: Job
    record: dict[str, Any]
    image: np.ndarray
    line: str
    doubt: str = ""
    status: str = ""
    iterations: int = 0
    findings: tuple[Finding, ...] = ()


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
    rig, focused = Inputs(sources), []
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


def _run_job(
    job: Job, rig: Inputs, recipe: Recipe, output: Output, report: Report | None
) -> Finished:
    began = time.perf_counter()
    examined, background = rig.examine(job)
    ready = rig.ready(examined, background)
    _check_channels(job, ready, recipe, output)
    rig.tell(examined.findings, recipe.strict)
    noise = pixel_noise(ready, recipe.noise)
    refinement, words = {}, ""
    if recipe.refine:
        ready, refinement, words = _refined(ready, noise)
    made = _reconstruct(job, ready, recipe, noise, report)
    rig.tell(() if made.doubt and not recipe.strict else made.findings, recipe.strict)
    findings = (*examined.findings, *made.findings)
    image = made.image[:, ::-1, ::-1] if recipe.flip else made.image
    shown = {"gamma": output.gamma, "white_balance": output.white_balance}
    record = {
        "capture": job.capture,
        **({"exposures": [job.capture, *job.others]} if job.others else {}),
        "sources": _source_facts(rig.sources),
        "preparation": asdict(ready.log),
        "examination": [asdict(one) for one in findings],
        **refinement,
        "reconstruction": made.record | {"noise": {"counts": noise.counts, "found": noise.found}},
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
    beside: dict[Path, bytes] = {}
    if (intervals := output.intervals) is not None:
        beside, width = _ends(job, intervals.of(np.asarray(image, float)))
        known = {"probability": intervals.probability, "pictures": intervals.pictures}
        record["intervals"] = {**known, "levels": intervals.levels, "mean_width": width}
    write_job(job, image, record, output, beside)
    return replace(made, record=record, image=image, line=f"{job.images[0]}: {made.line}{words}")


def _refined(ready: Prepared, noise: PixelNoise) -> tuple[Prepared, dict[str, Any], str]:
    """The capture with its PSF refined, the record of that, and words for the line."""
    with read_as("--refine"):
        found = refine(prepared_recording(ready, noise), parameters=("scale", "turn"))
    facts = {one.name: getattr(found, one.name) for one in fields(found) if one.name != "recording"}
    if not found.is_changed:
        return ready, {"refinement": facts}, "; PSF fits as it is"
    psf = changed_psf(ready.psf, found.values)
    words = f"; PSF refined: {', '.join(found.numbers)}"
    return replace(ready, psf=psf), {"refinement": facts}, words


def _ends(job: Job, ends: tuple[np.ndarray, np.ndarray]) -> tuple[dict[Path, bytes], float]:
    """Files of the ends of intervals and of a map of their widths, and the mean width."""
    from thincam_jax.plot.frame import as_png
    from thincam_jax.plot.images import draw_widths

    *linear, drawn = job.beside
    pairs = zip(linear, ends, strict=True)
    files = {p: linear_bytes(end.astype(np.float32), p.suffix.lower()) for p, end in pairs}
    width = ends[1] - ends[0]
    return files | {drawn: as_png(draw_widths(width))}, float(width.mean())


def _join(job: Job, images: list[np.ndarray], rig: Inputs, output: Output) -> Finished:
    """The image that is sharp everywhere, with the depth map; of one image for each distance."""
    from thincam_jax.plot.frame import as_png
    from thincam_jax.plot.refocus import draw_depth, draw_sweep

    began, distances = time.perf_counter(), rig.sources.distances
    if len(images) != len(distances):
        raise measured.MeasurementError(
            f"{job.images[0]}: is not made, nor a depth map: {len(images)} of {len(distances)} "
            "distances could be reconstructed"
        )
    sweep, depth, sharp = depth_of_colours(np.stack(images), distances)
    sharp, distance = np.asarray(sharp), np.asarray(depth.distance, np.float32)[None]
    sheet, map_, *linear = job.beside
    beside = {
        sheet: as_png(draw_sweep(sweep)),
        map_: as_png(draw_depth(sweep, depth, sharp.mean(axis=0))),
    } | {path: linear_bytes(distance, path.suffix.lower()) for path in linear}
    record = {
        "capture": job.capture,
        "sources": _source_facts(rig.sources),
        "psfs": [psf.name for psf in rig.psfs],
        "files": [path.name for path in (*job.images, *job.beside)],
        "environment": environment(time.perf_counter() - began),
    }
    write_job(job, sharp, record, output, beside)
    others = ", ".join(path.name for path in job.beside)
    line = f"{job.images[0]}: each part from the distance it is sharp at; {others}"
    return Finished(job, record, sharp, line)


def _source_facts(sources: Sources) -> dict[str, Any]:
    """Facts of the sources, without those of the preparation."""
    names = ("background", "psf_background", "dead", "bits", "psf_bits")
    psf = sources.psf.name if isinstance(sources.psf, measured.Raw) else sources.psf
    facts = {"psf": psf, **{name: getattr(sources, name) for name in names}}
    return facts | ({"distances_mm": sources.distances} if sources.distances else {})


def _reconstruct(
    job: Job, ready: Prepared, recipe: Recipe, noise: PixelNoise, report: Report | None
) -> Finished:
    """The image, unturned; its record is of the method alone."""
    solver = recipe.solver(len(ready.capture))
    # Conjugate gradients are one compiled program, without progress.
    trained = is_trained(recipe.method)
    callback = partial(report, job.name) if report and not (recipe.is_ridge or trained) else None
    with read_as("--method") if trained else nullcontext():  # of another camera
        done = reconstruct_prepared(ready, solver, noise, callback=callback, name=str(job.capture))
    found = done.found
    if found.status == "non_finite" and recipe.method == "pnp":
        raise measured.MeasurementError(
            f"{job.capture}: the image became NaN or infinite; use --method admm-tv"
        )
    name, value = ("ridge", recipe.relative_ridge) if recipe.is_ridge else ("tau", recipe.tau)
    if found.status == "non_finite":
        now = recipe.relative_tau if value is None else value
        raise measured.MeasurementError(
            f"{job.capture}: the image became NaN or infinite after {found.iterations} iterations; "
            f"give a {name} (now {now:g}) that is nearer to 1"
        )
    if found.status == "interrupted" and not found.iterations:
        raise KeyboardInterrupt
    residual, doubt = done.relative_residual, ""
    left, least = _left(ready, done)
    if not residual < _UNEXPLAINED or left > max(_UNEXPLAINED, least):  # or no number
        why = (
            f"{name} = {value:g} is too large, give about 1" if value else "the PSF may be another"
        )
        doubt = f"the image explains almost nothing of the capture; {why}"
    line = (
        f"{found.ending}; relative data residual {residual:.3g}, {found.seconds:.1f} s, "
        f"noise {noise.counts:.3g} counts ({noise.found.split()[0]})"
        + (f"; {found.reason}" if found.reason else "")
    )
    image, facts = done.image(recipe.field), _facts(done, recipe)
    findings = () if found.status == "interrupted" else tuple(_doubts(job, ready, done))
    ending = found.status, found.iterations, findings
    return Finished(job, facts, image, line, doubt, *ending)


def _left(ready: Prepared, done: PreparedResult) -> tuple[float, float]:
    """Residual of a capture in parts of its variation, and the least that is not noise."""
    light = ready.capture[ready.valid].astype(float)
    varies = max(float(light.std()), 1e-30)
    left = done.relative_residual * float(np.sqrt(np.mean(light**2))) / varies
    return left, 3 * done.pixel_deviation / varies


def _doubts(job: Job, ready: Prepared, done: PreparedResult) -> Iterator[Finding]:
    """A residual far above the noise, and a given noise that is not the one found."""
    where, (left, least) = f"capture {job.capture}", _left(ready, done)
    if why := done.found.reason:
        yield finding(
            "misfit", where, 3 * left / least, why.endswith((TURN, RESIZE, NEGATIVE)), why
        )
    if left > max(_SUSPECT, least):
        yield finding("unexplained", where, 100 * left, True)
    given, found = done.noise.counts, pixel_noise(ready).counts
    if done.noise.found == "given" and not given / 3 <= found <= 3 * given:
        yield finding("noise", where, found, False, f"{given:g}")


def _facts(done: PreparedResult, recipe: Recipe) -> dict[str, Any]:
    problem, has_tau = done.problem, isinstance(done.solver, AbstractRegularised)
    prior = problem.regulariser
    assert isinstance(prior, TotalVariation)
    return asdict(done.facts) | {
        "asked_for": recipe.method,
        "reason": choose_solver(done.recording)[1] if recipe.method == "auto" else "",
        "tau": recipe.relative_tau if has_tau else None,
        "absolute_tau": problem.absolute_tau if has_tau else None,
        "ridge": recipe.relative_ridge if recipe.is_ridge else None,
        "variation": {"kind": prior.kind, "coupling": prior.coupling} if has_tau else None,
        "nonnegative": problem.nonnegative and not recipe.is_ridge,
        "iterations_at_most": getattr(done.solver, "iterations", None),
    }


def _check_channels(job: Job, ready: Prepared, recipe: Recipe, output: Output) -> None:
    """Refuse what would otherwise fail after the reconstruction."""
    channels = ready.capture.shape[0]
    if recipe.coupling == "opponent" and channels != 3:
        raise measured.MeasurementError(
            f"{job.capture}: has {channels} channels and coupling 'opponent' is for 3; "
            "choose 'joint' or 'none'"
        )
    known = output.intervals
    if known is not None and len(known.gain) != channels:
        raise measured.MeasurementError(
            f"{job.capture}: has {channels} channels, and the intervals are of images of "
            f"{len(known.gain)}; give those of such captures"
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
    check_channels(ready, str(job.capture))


def check_files(
    sources: Sources,
    capture: Path,
    search: float,
    report: Callable[[int, int | None], object],
    out: Path | None = None,
) -> tuple[list[str], bool]:
    """The lines that report `check_psf` of two files, and whether the PSF fits.

    - `out`: file for the refined PSF, on the pixels of the files.
    """
    if out is not None and out.suffix.lower() not in LINEAR:
        raise measured.MeasurementError(f"--refine {out}: give a file .npy or .tif")
    rig = Inputs(sources)
    ready = rig.prepare(capture)
    shape, block = ready.capture.shape[-2:], sources.preparation.downsample
    recording = prepared_recording(ready)
    try:
        found = check_psf(recording, search=search, callback=report)
    except ValueError as error:
        raise measured.MeasurementError(str(error)) from None
    size = f"{shape[0]}×{shape[1]} pixels, blocks of {block}"
    lines = [f"{sources.psf} with {capture} at {size}:", str(found)]
    if out is None:
        return lines, found.fits
    if found.orientation != "as given":
        return [*lines, "nothing refined: correct the PSF's orientation first"], False
    better = refine(recording, search=search, callback=lambda done: report(done, None))
    if not better.is_changed:
        return [*lines, str(better), "nothing written"], found.fits
    whole = replace(sources, preparation=replace(sources.preparation, downsample=1))
    changes = better.values | {"blur": better.values.get("blur", 0.0) * block**2}
    psf = changed_psf(Inputs(whole).prepare(capture).psf, changes)
    measured.write_image(out, _BRIGHTEST * psf / psf.max())
    return [*lines, str(better), f"written: --psf {out} --psf-background 0"], True


def enough_blocks(sources: Sources, capture: Path) -> Sources:
    """Sources with blocks that leave some 160 pixels of a side, 320 where these blur the PSF."""
    whole = Inputs(sources).prepare(capture)
    side = max(whole.capture.shape[-2:])
    fine, coarse = (max(1, round(side / pixels)) for pixels in (2 * _SIDE, _SIDE))
    block = fine if blocks_blur(whole.psf, fine) else coarse
    return replace(sources, preparation=replace(sources.preparation, downsample=block))


def run_with_bar(jobs: list[Job], sources: Sources, recipe: Recipe, output: Output) -> int:
    """Work through the jobs with a progress bar; returns the exit code."""
    end = 0
    with progress_bar("{task.fields[objective]}") as bar:
        limit = getattr(recipe.solver(1), "iterations", 0)
        teller = _Bar(bar, limit, [job.name for job in jobs if job.focus is not None])
        for result in run_jobs(jobs, sources, recipe, output, teller):
            if isinstance(result, Failed):
                tell(in_a_line(result.error))
                end = WRONG_INPUT
                continue
            if terminal.output == "text":  # above the bar
                line = escaped(result.line)
                bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
            else:
                say_result("image", result.job.images[0])
                if found := result.record.get("examination"):
                    say_result("findings", found)
            if result.job.focus is None:
                continue
            if result.doubt:
                tell(f"{result.job.images[0]}: {result.doubt}")
            if result.status == "interrupted":
                tell(_interrupted(result.job, jobs))
                return INTERRUPTED
            teller.finish(result.iterations)
    return end


class _Bar:
    """One bar for the capture at work, with its number and the objective."""

    def __init__(self, bar: rich.progress.Progress, iterations: int, names: list[str]):
        self.bar, self.iterations, self.names = bar, iterations, names
        self.name = names[0]
        self.task = bar.add_task(self._title(), total=iterations, objective="")

    def __call__(self, name: str, progress: Progress) -> None:
        if name != self.name:
            self.name = name
            self.bar.reset(self.task, description=self._title(), total=self.iterations)
        objective = f"objective {progress.objective:.4g}"
        done = {"completed": progress.iteration, "objective": objective}
        self.bar.update(self.task, **done)
        self.bar.start()

    def finish(self, iterations: int) -> None:
        """Full, also where fewer iterations were enough."""
        self.bar.update(self.task, completed=iterations, total=iterations)
        self.bar.start()

    def _title(self) -> str:
        count = len(self.names)
        number = f" ({self.names.index(self.name) + 1} of {count})" if count > 1 else ""
        return self.name + number


def _interrupted(job: Job, jobs: list[Job]) -> str:
    jobs = [one for one in jobs if one.focus is not None]
    what = "distances" if job.label else "captures"
    left = len(jobs) - jobs.index(job) - 1
    rest = f"; not begun: {left} of {len(jobs)} {what}" if left else ""
    return f"interrupted; {job.images[0]} is the best image so far{rest}"
