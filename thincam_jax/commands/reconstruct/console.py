"""Between the command line and a run: what was typed, a progress bar, a line for each capture."""

from pathlib import Path

import rich.markup
import rich.progress

from thincam_jax.commands.interrupt import INTERRUPTED
from thincam_jax.commands.reconstruct.camera import computed_psf, read_camera
from thincam_jax.commands.reconstruct.jobs import Job
from thincam_jax.commands.reconstruct.options import Background, Focusing, Output, Recipe, Sources
from thincam_jax.commands.reconstruct.run import Failed, Finished, run_jobs
from thincam_jax.commands.terminal import WRONG_INPUT, in_a_line, progress_bar, tell
from thincam_jax.measured import MeasurementError, Raw
from thincam_jax.measured.write import WhiteBalance
from thincam_jax.reconstruction import Progress
from thincam_jax.reconstruction.depth.refocus import increasing
from thincam_jax.units import parse_quantity


def read_background(text: str | None) -> Background:
    """A dark frame's path, or a number of counts."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return Path(text)


def known_psf(
    psf: Path | None,
    camera: Path | None,
    overrides: list[str] | None,
    network: Path | None,
    distance: str | None,
    background: str | None,
) -> tuple[Path | Raw, Focusing | None]:
    """The file of a measured PSF; or the PSF of a camera, and its network.

    **Errors**: MeasurementError where not one of PSF and camera is given, and where a computed PSF
    comes without a background; ConfigError of the camera and the network.
    """
    if (psf is None) == (camera is None):
        raise MeasurementError(
            "give either --psf, a measured PSF, or --camera, a study with the camera's numbers"
        )
    if camera is None:
        if overrides:
            raise MeasurementError("--set changes the file of --camera; leave it out with --psf")
        if network is not None:
            raise MeasurementError("--network is of a camera; give --camera in place of --psf")
    if distance is not None and network is None:
        raise MeasurementError("--distance is that of a --network; see --distances for others")
    if psf is not None or camera is None:
        assert psf is not None  # one of the two is given
        return psf, None
    try:
        focused = None if distance is None else parse_quantity(distance, "length")
    except ValueError as error:
        raise MeasurementError(f"--distance: {error}") from None
    cameras = read_camera(camera, overrides or (), focused)
    focusing = None
    if network is not None:
        from thincam_jax.commands.reconstruct.network import read_network

        focusing = read_network(network, cameras)
    if background is None:
        raise MeasurementError(
            "--camera: a computed PSF has no dark corner; give --background, a dark frame or a "
            "number of counts"
        )
    return computed_psf(camera, cameras), focusing


def read_distances(text: str | None, psf: Path | None) -> tuple[float, ...]:
    """Distances of measured PSFs, mm, from "60mm,80mm,100mm".

    **Errors**: MeasurementError where they are none, not increasing, or there is no measured PSF.
    """
    if text is None:
        return ()
    if psf is None:
        raise MeasurementError("--distances are those of measured PSFs; give them by --psf")
    try:
        distances = increasing([parse_quantity(part, "length") for part in text.split(",")])
    except ValueError as error:
        raise MeasurementError(f"--distances {text}: {error}") from None
    return tuple(distances)


def read_corner(text: str) -> tuple[int, int]:
    """The first pixel of the corner and the one after its last, from "5:15".

    **Errors**: MeasurementError for anything else.
    """
    try:
        first, last = (int(part) for part in text.split(":"))
        if not 0 <= first < last:
            raise ValueError
    except ValueError:
        raise MeasurementError(
            f"--corner {text}: give the first pixel and the one after the last, as 5:15"
        ) from None
    return first, last


def read_white_balance(text: str | None) -> WhiteBalance:
    """The gains of the colours, or how to find them.

    **Errors**: MeasurementError for anything else.
    """
    if text is None:
        return None
    if text.replace("-", "_") == "grey_world":
        return "grey_world"
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        raise MeasurementError(
            f"--white-balance {text}: give grey-world, or the gains of red, green and blue as "
            "1.8,1,1.4"
        ) from None
    return red, green, blue


def run_with_bar(jobs: list[Job], sources: Sources, recipe: Recipe, output: Output) -> int:
    """Work through the jobs with a progress bar; returns the exit code."""
    end = 0
    with progress_bar("{task.fields[objective]}") as bar:
        teller = _Bar(bar, recipe.iterations, [job.name for job in jobs if job.focus is not None])
        for result in run_jobs(jobs, sources, recipe, output, teller):
            if isinstance(result, Failed):
                tell(in_a_line(result.error))
                end = WRONG_INPUT
                continue
            bar.console.print(_summary(result), highlight=False, markup=False, soft_wrap=True)
            if result.job.focus is None:
                continue
            if (doubt := _doubt(result, recipe)) is not None:
                tell(doubt)
            if result.status == "interrupted":
                tell(_interrupted(result.job, jobs))
                return INTERRUPTED
            teller.finish(result.record["reconstruction"]["iterations"])
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
        return rich.markup.escape(self.name) + number


def _summary(result: Finished) -> str:
    if result.job.focus is None:
        others = ", ".join(path.name for path in result.job.beside)
        return f"{result.job.images[0]}: each part from the distance it is sharp at; {others}"
    done = result.record["reconstruction"]
    status, noise = done["status"].replace("_", " "), done["noise"]
    if result.learned:
        return (
            f"{result.job.images[0]}: focused on {done['focused_on_mm']:g} mm, residual "
            f"{done['consistency']:.2f} of the noise, not sure of {100 * done['unsure']:.0f} % of "
            f"the pixels, {done['seconds']:.1f} s"
        )
    return (
        f"{result.job.images[0]}: {status} after {done['iterations']} iterations, relative data "
        f"residual {float(done['relative_data_residual']):.3g}, {done['seconds']:.1f} s, noise "
        f"{noise['counts']:.3g} counts ({noise['found'].split()[0]})"
    )


def _doubt(result: Finished, recipe: Recipe) -> str | None:
    """What is wrong with an image that does not explain its capture; None where it does."""
    if result.learned:
        words = result.record["reconstruction"]["doubt"]
        return f"{result.job.images[0]}: {words}" if words else None
    residual = float(result.record["reconstruction"]["relative_data_residual"])
    if residual < _UNEXPLAINED:
        return None
    name, value = ("ridge", recipe.relative_ridge) if recipe.is_ridge else ("tau", recipe.tau)
    asked = f"{name} = {value:g} is too large, give about 1" if value else "the PSF may be another"
    return f"{result.job.images[0]}: the image explains almost nothing of the capture; {asked}"


_UNEXPLAINED = 0.9  # of the capture's norm


def _interrupted(job: Job, jobs: list[Job]) -> str:
    jobs = [one for one in jobs if one.focus is not None]
    what = "distances" if job.label else "captures"
    left = len(jobs) - jobs.index(job) - 1
    rest = f"; not begun: {left} of {len(jobs)} {what}" if left else ""
    return f"interrupted; {job.images[0]} is the best image so far{rest}"
