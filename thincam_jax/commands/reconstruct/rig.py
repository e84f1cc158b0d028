"""Sources of reconstructions, read once, and the captures that go with them."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from thincam_jax import measured
from thincam_jax.commands import terminal
from thincam_jax.commands.reconstruct.jobs import Job
from thincam_jax.commands.reconstruct.options import Background, Sources
from thincam_jax.measured.dark import without_hot_pixels
from thincam_jax.measured.examination import Examination, Finding, examine
from thincam_jax.measured.merging import merge_images
from thincam_jax.measured.preparation import Background as Level
from thincam_jax.measured.read import pair_backgrounds

_SAME = 0.1  # relative difference of exposures that are rounded


class Rig:
    """`Sources`, read once."""

    def __init__(self, sources: Sources):
        self.sources = sources
        self.dead = None if sources.dead is None else measured.read_mask(sources.dead)
        self.warned: set[str] = set()
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
            self.psfs = [self._marked(one) for one in measured.read_images(given, psf_bits)]
            if len(self.psfs) != len(sources.distances):
                raise measured.MeasurementError(
                    f"{given}: holds {len(self.psfs)} PSFs for {len(sources.distances)} distances; "
                    "give one for each, nearest first"
                )
        else:
            files, paths = given if isinstance(given, tuple) else (given,), ()
            if isinstance(of_psf, Path) and of_psf.is_dir():
                paths = pair_backgrounds(files, of_psf)
            psf, self.psf_background = self._read(files, paths, psf_bits, 0)
            self.psfs = [psf]

    def examine(self, job: Job) -> tuple[Examination, Level | None]:
        """Examination of a job's capture, and its background."""
        files = job.capture, *job.others
        image, background = self._read(files, job.backgrounds, self.sources.bits, 1)
        found = examine([image], self.psfs[job.focus or 0], self.sources.preparation)
        return found, background

    def prepare(self, capture: Path) -> measured.Prepared:
        return self.ready(*self.examine(Job(capture, ())))

    def ready(self, examined: Examination, background: Level | None) -> measured.Prepared:
        psf, (image,) = examined.psf, examined.captures
        assert psf is not None
        known = {"psf_background": self.psf_background, "dead": self.dead}
        return measured.prepare(psf, image, background, self.sources.preparation, **known)

    def tell(self, findings: Sequence[Finding], strict: bool) -> None:
        """Warn of findings, once of each; MeasurementError for a severe one if `strict`."""
        lines = [str(one) for one in findings]
        terminal.warn([line for line in lines if line not in self.warned])
        self.warned.update(lines)
        if bad := [str(one) for one in findings if strict and one.severe]:
            raise measured.MeasurementError(f"{bad[0]} (an error by --strict)")

    def _level(self, given: Background, bits: int | None) -> Level | None:
        """The background of all images; None of a folder, which has one for each."""
        if not isinstance(given, Path):
            return given
        return None if given.is_dir() else self._dark(given, bits)

    def _read(
        self, files: Sequence[Path], dark: Sequence[Path], bits: int | None, place: int
    ) -> tuple[measured.Raw, Level | None]:
        """One image, merged of its exposures, and its background; `place`: 0 PSF, 1 capture.

        `dark`: frame of each file, where they differ.
        """
        images = [self._marked(measured.read_image(path, bits)) for path in files]
        level = self.background if place else self.psf_background
        if level is None and not place and isinstance(self.background, measured.Raw):
            same = self.background.bits == images[0].bits
            level = self.background if same else None
        levels = [self._dark(path, bits) for path in dark] or [level] * len(files)
        for n, one in enumerate(levels):
            if isinstance(one, measured.Raw):
                images[n], levels[n] = without_hot_pixels(images[n], one, not place)
        if len(files) == 1:
            return images[0], levels[0]
        known = [one for one in levels if isinstance(one, measured.Raw | float | int)] or None
        times, options = self._times(images, place), self.sources.preparation
        merged = merge_images(images, times, known, options.saturation)
        return merged, merged.black_level

    def _marked(self, image: measured.Raw) -> measured.Raw:
        """The image with the dead pixels of the map, where that has its size."""
        if self.dead is None or self.dead.shape != image.pixels.shape[:2]:
            return image
        return replace(image, dead=self.dead if image.dead is None else self.dead | image.dead)

    def _times(self, images: Sequence[measured.Raw], place: int) -> list[float]:
        """Exposures, s, by the files, else as given: the PSF's first, a capture's last."""
        n, times = len(images), []
        given = self.sources.exposures[-n:] if place else self.sources.exposures[:n]
        for image, time in zip(images, given or [0.0] * n, strict=True):
            said = image.exposure or time
            if said == 0 or (time and abs(said / time - 1) > _SAME):
                raise measured.MeasurementError(
                    f"{image.name}: exposure by its file: {_seconds(image.exposure)}, by --exposure: "
                    f"{_seconds(time)}; give the right --exposure, as 4ms, of each of several files "
                    "of one PSF or capture, or other scenes as a folder"
                )
            times.append(said)
        return times


def _seconds(time: float | None) -> str:
    return f"{time:g} s" if time else "none"
