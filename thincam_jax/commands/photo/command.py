"""The command `thincam reconstruct`."""

from pathlib import Path
from typing import Annotated, Literal

import rich.markup
import rich.progress
import typer
from typer import Option

from thincam_jax.commands import photo as runs
from thincam_jax.commands.terminal import INTERRUPTED, WRONG_INPUT, columns, console, fail, tell
from thincam_jax.measured import MeasurementError, Preparation
from thincam_jax.measured.bayer import Demosaicing, Pattern
from thincam_jax.measured.display import WhiteBalance
from thincam_jax.reconstruction import Progress

_METHODS = ", ".join(method.replace("_", "-") for method in runs.PSF_METHODS)


def reconstruct(
    psf: Annotated[Path, Option(help="Measured PSF: TIFF, PNG or NPY.")],
    capture: Annotated[Path, Option(help="Capture of the same size; or a folder of captures.")],
    out: Annotated[
        Path, Option(help="Image (.png, .npy, .tif); a folder for a folder of captures.")
    ],
    background: Annotated[
        str | None,
        Option(help="Dark frame, or a number of counts. Default: a corner of the PSF."),
    ] = None,
    psf_background: Annotated[
        str | None, Option(help="That of the PSF, where it was exposed otherwise.")
    ] = None,
    downsample: Annotated[int, Option(help="Side of the blocks of pixels that are averaged.")] = 1,
    bits: Annotated[int | None, Option(help="Bit depth, as 12 where 16 are stored.")] = None,
    bayer: Annotated[
        Pattern | None, Option(help="Colours of the mosaic, from its upper left.")
    ] = None,
    demosaic: Annotated[
        Demosaicing, Option(help="superpixel joins 2×2 pixels: half the size.")
    ] = "bilinear",
    dead: Annotated[Path | None, Option(help="Map of dead pixels, not zero where dead.")] = None,
    saturation: Annotated[
        float | None, Option(help="Saturated from this part of full scale on.")
    ] = None,
    noise_threshold: Annotated[
        float | None, Option(help="Set the PSF to 0 below so many times its noise.")
    ] = None,
    psf_channels: Annotated[
        Literal["each", "mean"], Option(help="each: a PSF for each colour; mean: one for all.")
    ] = "each",
    method: Annotated[str, Option(help=f"One of {_METHODS}.")] = "admm-tv",
    tau: Annotated[
        float | None,
        Option(help="Weight of total variation relative to noise, about 1 to 3. Default: 2."),
    ] = None,
    ridge: Annotated[
        float | None,
        Option(help="Of ridge: noise over image variance, in parts of the expected. Default: 1."),
    ] = None,
    iterations: Annotated[int, Option(help="At most.")] = 100,
    coupling: Annotated[
        Literal["none", "joint", "opponent"] | None,
        Option(help="Of colours, in total variation. Default: joint."),
    ] = None,
    field: Annotated[
        Literal["sensor", "full"], Option(help="sensor: what is in front of it; full: all it sees.")
    ] = "sensor",
    flip: Annotated[bool, Option("--flip", help="Turn the image by 180°.")] = False,
    linear: Annotated[
        Literal["npy", "tif", "none"], Option(help="Format of the float image beside a PNG.")
    ] = "npy",
    gamma: Annotated[float, Option(help="Of the PNG.")] = 2.2,
    white_balance: Annotated[
        str | None, Option(help="Of the PNG: grey-world, or gains as 1.8,1,1.4.")
    ] = None,
) -> None:
    """Reconstruct a capture, or a folder of captures, with a measured PSF.

    Writes the image, its linear values and a JSON record of all that was done. Ctrl-C keeps the
    best image so far.
    """
    try:
        sources = runs.Sources(
            psf,
            _background(background),
            _background(psf_background),
            dead,
            bits,
            Preparation(
                bayer=bayer,
                demosaicing=demosaic,
                downsample=downsample,
                saturation=saturation,
                noise_threshold=noise_threshold,
                psf_channels=psf_channels,
            ),
        )
        recipe = runs.Recipe(
            method=method.replace("-", "_"),
            tau=tau,
            iterations=iterations,
            coupling=coupling,
            field=field,
            flip=flip,
            ridge=ridge,
        )
        output = runs.Output(out, linear, gamma, _white_balance(white_balance))
        end = _run(runs.plan_jobs(capture, sources, output), sources, recipe, output)
    except (MeasurementError, MemoryError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        tell("interrupted; of the capture at work no image is there yet, nothing of it is kept")
        raise typer.Exit(INTERRUPTED) from None
    if end:
        raise typer.Exit(end)


def _run(jobs: list[runs.Job], sources: runs.Sources, recipe: runs.Recipe, output: runs.Output):
    """Work through the jobs with a progress bar; returns the exit code."""
    end = 0
    with rich.progress.Progress(*columns("{task.fields[objective]}"), console=console) as bar:
        teller = _Bar(bar, recipe.iterations, [job.capture.name for job in jobs])
        for result in runs.run_jobs(jobs, sources, recipe, output, teller):
            if isinstance(result, runs.Failed):
                tell(str(result.error))
                end = WRONG_INPUT
                continue
            console.print(_summary(result), highlight=False, markup=False, soft_wrap=True)
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
        self.bar.update(self.task, completed=progress.iteration, objective=objective)

    def finish(self, iterations: int) -> None:
        """Full, also where fewer iterations were enough."""
        self.bar.update(self.task, completed=iterations, total=iterations)

    def _title(self) -> str:
        count = len(self.names)
        number = f" ({self.names.index(self.name) + 1} of {count})" if count > 1 else ""
        return rich.markup.escape(self.name) + number


def _summary(result: runs.Finished) -> str:
    done = result.record["reconstruction"]
    status = done["status"].replace("_", " ")
    return (
        f"{result.job.images[0]}: {status} after {done['iterations']} iterations, relative data "
        f"residual {float(done['relative_data_residual']):.3g}, {done['seconds']:.1f} s"
    )


def _interrupted(job: runs.Job, jobs: list[runs.Job]) -> str:
    left = len(jobs) - jobs.index(job) - 1
    rest = f"; not begun: {left} of {len(jobs)} captures" if left else ""
    return f"interrupted; {job.images[0]} is the best image so far{rest}"


def _background(text: str | None) -> Path | float | None:
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return Path(text)


def _white_balance(text: str | None) -> WhiteBalance:
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
