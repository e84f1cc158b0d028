"""Jobs: which captures become which files, checked before any work, and what each is made of."""

import functools
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax import measured
from thincam_jax._core.files import write_whole, writing
from thincam_jax.commands import terminal
from thincam_jax.commands.reconstruct.options import Background, Output, Sources
from thincam_jax.measured import MeasurementError, write_image
from thincam_jax.measured.examination import Examination, Finding, examine
from thincam_jax.measured.merging import merge_images, without_hot_pixels
from thincam_jax.measured.preparation import Background as Level
from thincam_jax.measured.preparation import Prepared
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import image_files, pair_backgrounds, read_images
from thincam_jax.measured.write import LINEAR


@dataclass(frozen=True)
class Job:
    """One capture and the images to be made of it; the record stands beside them as NAME.json.

    - `focus`: number of the distance, if there are several; None: all before, as one
      image that is sharp everywhere.
    - `label`: that distance, for messages.
    - `beside`: further files.
    - `others`: further exposures of the capture. `backgrounds`: the exposures', where
      they differ.
    """

    capture: Path
    images: tuple[Path, ...]
    focus: int | None = 0
    label: str = ""
    beside: tuple[Path, ...] = ()
    others: tuple[Path, ...] = ()
    backgrounds: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        return self.capture.name + self.label

    @property
    def record(self) -> Path:
        return self.images[0].with_suffix(".json")

    @property
    def is_shown(self) -> bool:
        """Whether one of the images is for looking at."""
        return self.images[0].suffix.lower() == ".png"


class Inputs:
    """`Sources`, read once."""

    def __init__(self, sources: Sources):
        self.sources, self.warned = sources, set[str]()
        self.dead = None if sources.dead is None else measured.read_pixel_map(sources.dead)
        self._dark = functools.lru_cache(8)(measured.read_image)
        psf_bits = sources.bits if sources.psf_bits is None else sources.psf_bits
        given, of_psf = sources.psf, sources.psf_background
        self.background = self._level(sources.background, sources.bits)
        if of_psf is None and self.background is None and sources.background is not None:
            of_psf = "found"  # a folder is of the captures
        self.psf_background = self._level(of_psf, psf_bits)
        if isinstance(given, measured.Raw):
            self.psfs = [given]
        elif sources.distances:
            assert isinstance(given, Path)
            self.psfs = read_images(given, psf_bits)
            if len(self.psfs) != len(sources.distances):
                raise MeasurementError(
                    f"{given}: holds {len(self.psfs)} PSFs for {len(sources.distances)} distances; "
                    "give one for each, nearest first"
                )
        else:
            files = given if isinstance(given, tuple) else (given,)
            paired = files, pair_backgrounds(files, of_psf)
            *self.psfs, self.psf_background = self._read(*paired, psf_bits, is_psf=True)

    def examine(self, job: Job) -> tuple[Examination, Level | None]:
        """Examination of a job's capture, and its background."""
        files = job.capture, *job.others
        image, background = self._read(files, job.backgrounds, self.sources.bits)
        psf = self.psfs[job.focus or 0]
        return examine([image], psf, self.sources.preparation), background

    def prepare(self, capture: Path) -> Prepared:
        paired = tuple(pair_backgrounds([capture], self.sources.background))
        return self.ready(*self.examine(Job(capture, (), backgrounds=paired)))

    def ready(self, examined: Examination, background: Level | None) -> Prepared:
        psf, (image,) = examined.psf, examined.captures
        assert psf is not None
        known = {"psf_background": self.psf_background, "dead": self.dead}
        return measured.prepare(
            psf, image, background=background, options=self.sources.preparation, **known
        )

    def tell(self, findings: Sequence[Finding], strict: bool) -> None:
        """Warn of findings, once of each; MeasurementError for a severe one if `strict`."""
        lines = [str(one) for one in findings]
        terminal.warn([line for line in lines if line not in self.warned])
        self.warned.update(lines)
        if bad := [str(one) for one in findings if strict and one.severe]:
            raise MeasurementError(f"{bad[0]} (an error by --strict)")

    def _level(self, given: Background, bits: int | None) -> Level | None:
        """The background of all images; None of a folder, which has one for each."""
        if not isinstance(given, Path):
            return given
        return None if given.is_dir() else self._dark(given, bits=bits)

    def _read(
        self, files: Sequence[Path], dark: Sequence[Path], bits: int | None, is_psf: bool = False
    ) -> tuple[measured.Raw, Level | None]:
        """One image, merged of its exposures, and its background; `dark`: each file's."""
        n, given = len(files), self.sources.exposures if len(files) > 1 else ()
        times = (given[:n] if is_psf else given[-n:]) or (None,) * n
        images = [self._image(*one, bits) for one in zip(files, times, strict=True)]
        level = self.psf_background if is_psf else self.background
        if is_psf and level is None and isinstance(self.background, measured.Raw):
            level = self.background if self.background.bits == images[0].bits else None
        levels: list[Any] = [self._dark(path, bits=bits) for path in dark] or [level] * n
        for i, one in enumerate(levels):
            if isinstance(one, measured.Raw):
                images[i], levels[i] = without_hot_pixels(images[i], one)
        if n == 1:
            return images[0], levels[0]
        known = None if levels[0] in (None, "corner", "found") else levels
        merged = merge_images(images, known, self.sources.preparation.saturation)
        return merged, merged.black_level

    def _image(self, path: Path, exposure: float | None, bits: int | None) -> measured.Raw:
        """An image with its exposure and the dead pixels of the map, where that has its size."""
        image = measured.read_image(path, bits=bits)
        said, size = image.exposure or exposure, image.pixels.shape[:2]
        if said and exposure and abs(said / exposure - 1) > 0.1:  # more than rounded
            text = (
                f"{path}: its exposure is {said:g} s by the file and {exposure:g} s by --exposure"
            )
            raise MeasurementError(f"{text}; leave --exposure out, or remove the wrong tag")
        maps = [one for one in (image.dead, self.dead) if one is not None and one.shape == size]
        return replace(image, exposure=said, dead=np.any(maps, axis=0) if maps else None)


def plan_jobs(
    capture: Path, sources: Sources, output: Output, others: tuple[Path, ...] = ()
) -> list[Job]:
    """Jobs for a capture and `others`, its further exposures, or for each capture in a folder.

    Files of the folder that `sources` names are no captures. Nothing is written yet, but whether
    something can be is tried.

    **Errors**: MeasurementError, one line, for a folder without captures or that is also the
    output's, backgrounds that do not pair, an output that cannot be written or that would overwrite
    an input, and two captures of the same name.
    """
    batch = capture.is_dir() and not others
    captures = _captures_in(capture, sources) if batch else [capture]
    folder = output.path if batch or output.path.is_dir() else output.path.parent
    if batch:
        _check_batch_folder(capture, folder)
    names = [output.path if folder != output.path else folder / f"{c.stem}.png" for c in captures]
    planned = zip(captures, names, strict=True)
    jobs = [job for c, n in planned for job in _jobs_of(c, n, sources, output)]
    found = pair_backgrounds([*captures, *others], sources.background)
    pairs = {c: tuple(found) if others else (b,) for c, b in zip(captures, found, strict=False)}
    jobs = [replace(j, others=others, backgrounds=pairs.get(j.capture, ())) for j in jobs]
    _check_names(jobs, sources)
    _check_writable(folder)
    return jobs


def _jobs_of(capture: Path, path: Path, sources: Sources, output: Output) -> list[Job]:
    """One for each distance, and one of all of them; or the only one."""
    images = _images(path, output)
    if not sources.distances:
        linear = next((p.suffix for p in images if p.suffix.lower() in LINEAR), ".npy")
        names: list[str] = []
        if output.intervals is not None:
            names = [f"-lower{linear}", f"-upper{linear}", "-width.png"]
        beside = tuple(path.with_name(f"{path.stem}{name}") for name in names)
        return [Job(capture, images, beside=beside)]
    jobs = []
    for focus, distance in enumerate(sources.distances):
        name = path.with_name(f"{path.stem}-{distance:g}mm{path.suffix}")
        jobs.append(Job(capture, _images(name, output), focus, f" at {distance:g} mm"))
    drawn = (path.with_name(f"{path.stem}-{name}.png") for name in ("sweep", "depth"))
    linear = (p.with_name(f"{p.stem}-depth{p.suffix}") for p in images if p.suffix != ".png")
    return [*jobs, Job(capture, images, None, beside=(*drawn, *linear))]


def write_job(
    job: Job,
    image: np.ndarray,
    record: dict[str, Any],
    output: Output,
    beside: Mapping[Path, bytes] | None = None,
) -> None:
    """All files of a job, complete before the first of them takes its name; the record first."""
    folder = job.record.parent
    with writing(job.images[0]):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".thincam-", dir=folder) as staging:
            shown = {"white_balance": output.white_balance, "gamma": output.gamma}
            for path in job.images:
                write_image(Path(staging) / path.name, image, record, **shown)
            for path, content in (beside or {}).items():
                write_whole(Path(staging) / path.name, content)
            for path in (job.record, *job.images, *job.beside):
                os.replace(Path(staging) / path.name, path)


def _captures_in(folder: Path, sources: Sources) -> list[Path]:
    used = {os.path.realpath(path) for path in sources.paths()}
    captures = [path for path in image_files(folder) if os.path.realpath(path) not in used]
    if not captures:
        raise CaptureFileError(f"{folder}: holds no capture beside the PSF and what is subtracted")
    return captures


def _images(path: Path, output: Output) -> tuple[Path, ...]:
    """The image files of a result for the output `path`."""
    suffix = path.suffix.lower()
    if suffix in LINEAR:
        return (path,)
    if suffix != ".png":
        raise MeasurementError(
            f"{path}: images are written as .png (for looking at), .npy or .tif (linear); give one "
            "of these suffixes, or a folder that exists"
        )
    return (path,) if output.linear == "none" else (path, path.with_suffix(f".{output.linear}"))


def _check_batch_folder(captures: Path, folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise MeasurementError(f"{folder}: is a file; for a folder of captures give a folder")
    if os.path.realpath(folder) == os.path.realpath(captures):
        raise MeasurementError(
            f"{folder}: holds the captures, among which the results would be lost; give another "
            "folder"
        )


def _check_names(jobs: list[Job], sources: Sources) -> None:
    read = (*sources.paths(), *(path for job in jobs for path in (job.capture, *job.others)))
    inputs = {os.path.realpath(path) for path in read}  # also of links in a circle
    taken: dict[Path, Path] = {}
    for job in jobs:
        for path in (job.record, *job.images, *job.beside):
            if os.path.realpath(path) in inputs:
                raise MeasurementError(
                    f"{path}: is read as an input and would be overwritten; give another output"
                )
            if path.is_dir():
                raise MeasurementError(f"{path}: is a folder; give another output")
        other = taken.setdefault(job.record, job.capture)
        if other != job.capture:
            raise MeasurementError(
                f"{job.capture} and {other.name} would both become {job.images[0].name}; "
                "rename one of them"
            )


def _check_writable(folder: Path) -> None:
    """Try it, or what is to hold it: what the system says of permissions is not the whole truth."""
    tried = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not tried.is_dir():
        raise MeasurementError(f"{tried}: is no folder; give another output")
    try:
        with tempfile.TemporaryDirectory(prefix=".thincam-", dir=tried):
            pass
    except OSError as error:
        raise MeasurementError(
            f"{tried}: cannot be written into ({error.strerror or error}); give another folder"
        ) from None
