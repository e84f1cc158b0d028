"""The command `thincam reconstruct`."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer
from typer import Argument, Option

from thincam_jax.commands.reconstruct import METHODS
from thincam_jax.commands.terminal import WRONG_INPUT, Overrides, reported, say_result

if TYPE_CHECKING:
    from thincam_jax.measured import Preparation

Bits = Annotated[int | None, Option(help="Bit depth of the camera, such as 12 in a file of 16.")]
Bayer = Annotated[
    Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None,
    Option(help="Colours of the Bayer mosaic, from its upper left."),
]
PsfChannels = Annotated[
    Literal["each", "mean"], Option(help="each: one PSF for each colour; mean: their mean for all.")
]
Crop = Annotated[
    str | None,
    Option(
        help="Rows and columns of the captures to use, such as 100:740,200:1000; the PSF stays."
    ),
]
Strict = Annotated[bool, Option("--strict", help="End with exit code 2 at a severe finding.")]


@dataclass(frozen=True)
class FileOptions:
    """Contents of captures and PSFs."""

    background: Annotated[
        str | None,
        Option(
            help="Black level: a dark frame, a folder of one each, counts, or corner. "
            "Default: found."
        ),
    ] = None
    psf_background: Annotated[
        str | None, Option(help="Black level of the PSF, if it was exposed differently.")
    ] = None
    bits: Bits = None
    psf_bits: Annotated[int | None, Option(help="Bit depth of the PSF, if it differs.")] = None
    corner: Annotated[
        str, Option(help="Dark corner of the PSF: its rows and columns, FIRST:AFTER_LAST.")
    ] = "5:15"
    psf_scale: Annotated[
        float | None,
        Option(help="Pixel pitch of the PSF over that of the capture; the PSF is enlarged by it."),
    ] = None
    bayer: Bayer = None
    dead: Annotated[
        Path | None, Option(help="Image that marks dead pixels by any value but zero.")
    ] = None

    def preparation(self, **more: Any) -> "Preparation":
        """Settings of `prepare`, and further ones."""
        from thincam_jax.commands.reconstruct.options import read_corner
        from thincam_jax.measured import Preparation

        corner = read_corner(self.corner)
        return Preparation(bayer=self.bayer, corner=corner, psf_scale=self.psf_scale, **more)


@dataclass(frozen=True)
class ImageOptions(FileOptions):
    """Contents of captures and PSFs, and their preparation for an image."""

    downsample: Annotated[int, Option(help="Average blocks of so many pixels a side.")] = 1
    demosaic: Annotated[
        Literal["bilinear", "superpixel"],
        Option(help="bilinear: all pixels; superpixel: joins 2×2 pixels to one, at half the size."),
    ] = "bilinear"
    saturation: Annotated[
        float | None, Option(help="Pixels from this part of full scale on count as saturated.")
    ] = None
    noise_threshold: Annotated[
        float | None, Option(help="Set the PSF to zero below so many times its noise.")
    ] = None

    def preparation(self, **more: Any) -> "Preparation":
        own = {n: getattr(self, n) for n in ("downsample", "saturation", "noise_threshold")}
        return super().preparation(demosaicing=self.demosaic, **own, **more)


@dataclass(frozen=True)
class SolverOptions:
    """Settings of a solver, by their names in `Recipe`."""

    tau: Annotated[
        float | None,
        Option(help="Weight of total variation relative to the noise, about 1 to 3. Default: 2."),
    ] = None
    ridge: Annotated[
        float | None,
        Option(help="Weight of the penalty of ridge, relative to the expected one. Default: 1."),
    ] = None
    noise: Annotated[
        float | None,
        Option(help="Standard deviation of a raw pixel's noise, counts. Default: estimated."),
    ] = None
    iterations: Annotated[
        int | None, Option(help="Most iterations. Default: 300; fista 100, pnp 5, ridge 1000.")
    ] = None
    coupling: Annotated[
        Literal["none", "joint", "opponent"] | None,
        Option(help="How total variation joins colours. Default: joint."),
    ] = None
    strict: Strict = False


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of each parameter that is a group of them."""
    parameters, groups = [], {}
    for name, parameter in inspect.signature(command).parameters.items():
        kind = parameter.annotation
        if isinstance(kind, type) and is_dataclass(kind):
            groups[name] = kind
            own = inspect.signature(kind).parameters.values()
            parameters += [one.replace(kind=parameter.KEYWORD_ONLY) for one in own]
        else:
            parameters.append(parameter)

    @functools.wraps(command)
    def call(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{one.name: given.pop(one.name) for one in fields(kind)})
        command(**given)

    cast(Any, call).__signature__ = inspect.Signature(parameters)
    return call


@grouped
def reconstruct(
    capture: Annotated[
        list[Path],
        Option(
            help="Capture, or a folder of captures. Repeat it for several exposures of one scene."
        ),
    ],
    out: Annotated[
        Path,
        Option(help="Image to write (.png, .npy, .tif), or a folder for a folder of captures."),
    ],
    psf: Annotated[
        list[Path] | None,
        Option(help="Image of the measured PSF. Repeat it for several exposures."),
    ] = None,
    exposure: Annotated[
        list[str] | None,
        Option(help="Exposure time, such as 4ms, for each file that does not hold it."),
    ] = None,
    distances: Annotated[
        str | None,
        Option(help="Refocus, as 60mm,80mm,100mm; --psf is a folder or TIFF with a PSF for each."),
    ] = None,
    camera: Annotated[
        Path | None,
        Option(help="Study (YAML) whose first shot describes the camera, in place of --psf."),
    ] = None,
    set_: Overrides = None,
    *,
    files: ImageOptions,
    crop: Crop = None,
    psf_channels: PsfChannels = "each",
    method: Annotated[
        str,
        Option(
            help=f"Reconstruction method: {', '.join(METHODS)}, or a file of 'thincam train'.",
            autocompletion=lambda: METHODS,
        ),
    ] = "admm-tv",
    solver: SolverOptions,
    field: Annotated[
        Literal["sensor", "full"],
        Option(
            help="Field of view. sensor: the scene in front of the sensor; full: all that it sees."
        ),
    ] = "sensor",
    flip: Annotated[bool, Option("--flip", help="Turn the image by 180°.")] = False,
    refine: Annotated[
        bool, Option("--refine", help="Correct the PSF's scale and rotation by each capture first.")
    ] = False,
    linear: Annotated[
        Literal["npy", "tif", "none"],
        Option(help="Format of the linear image that is written beside a PNG."),
    ] = "npy",
    intervals: Annotated[
        Path | None,
        Option(
            help="Intervals of the method by 'thincam evaluate' (intervals/METHOD.json), to draw."
        ),
    ] = None,
    gamma: Annotated[float, Option(help="Gamma of the PNG.")] = 2.2,
    white_balance: Annotated[
        str | None, Option(help="White balance of the PNG: grey-world, or gains such as 1.8,1,1.4.")
    ] = None,
) -> None:
    """Reconstruct captures with a known PSF.

    The PSF is measured, or computed from a camera's numbers. Takes one capture or a folder. Writes
    the image, its linear values and a JSON record of each step. Ctrl-C keeps the best image so far.
    """
    nothing = "interrupted; of the capture at work no image is there yet, nothing of it is kept"
    with reported(lambda: nothing):
        from thincam_jax.commands.reconstruct import options
        from thincam_jax.commands.reconstruct.jobs import plan_jobs
        from thincam_jax.commands.reconstruct.run import run_with_bar
        from thincam_jax.measured import MeasurementError

        sources = options.Sources(
            options.known_psf(psf or (), camera, set_),
            options.read_background(files.background),
            0.0 if camera else options.read_background(files.psf_background),
            files.dead,
            files.bits,
            files.preparation(crop=options.read_crop(crop), psf_channels=psf_channels),
            files.psf_bits,
            options.read_distances(distances, psf or ()),
            options.read_exposures(exposure or (), len(psf or ()), len(capture)),
        )
        name, settings = options.read_method(method), vars(solver)
        if refine and distances:
            raise MeasurementError("--refine is of one PSF; leave out --distances")
        recipe = options.Recipe(name, field=field, flip=flip, refine=refine, **settings)
        balance = options.read_white_balance(white_balance)
        ends = options.read_intervals(intervals, not distances, field)
        output = options.Output(out, linear, gamma, balance, ends)
        jobs = plan_jobs(capture[0], sources, output, tuple(capture[1:]))
        end = run_with_bar(jobs, sources, recipe, output)
    if end:
        raise typer.Exit(end)


@grouped
def check(
    psf: Annotated[Path, Option(help="Image of the measured PSF: TIFF, PNG or NPY.")],
    capture: Annotated[Path, Option(help="Capture of the PSF's size.")],
    *,
    files: FileOptions,
    downsample: Annotated[
        int | None,
        Option(help="Average blocks of so many pixels a side. Default: 160 pixels remain, or 320."),
    ] = None,
    crop: Crop = None,
    psf_channels: PsfChannels = "each",
    search: Annotated[
        float, Option(help="Range of scales to search, as a fraction: 0.06 is ±6 %.")
    ] = 0.06,
    refine: Annotated[
        Path | None,
        Option(help="Write the PSF with the scale, rotation and blur that fit best (.npy, .tif)."),
    ] = None,
) -> None:
    """Check that a PSF fits a capture, and refine it.

    Tries other scales, rotations and mirror images. The exit code is 1 if one of them fits
    better, unless --refine writes it.
    """
    with reported(lambda: "interrupted; nothing is known of the PSF"):
        from thincam_jax.commands.reconstruct import options
        from thincam_jax.commands.reconstruct.run import check_files, enough_blocks
        from thincam_jax.commands.terminal import progress_bar

        sources = options.Sources(
            psf,
            options.read_background(files.background),
            options.read_background(files.psf_background),
            files.dead,
            files.bits,
            files.preparation(
                downsample=1 if downsample is None else downsample,
                crop=options.read_crop(crop),
                psf_channels=psf_channels,
            ),
            files.psf_bits,
        )
        sources = enough_blocks(sources, capture) if downsample is None else sources
        with progress_bar() as bar:
            task = bar.add_task("PSFs", total=None)
            lines, fits = check_files(
                sources,
                capture,
                search,
                lambda n, of: bar.update(task, completed=n, total=of),
                refine,
            )
    say_result("findings", lines, "\n".join(lines))
    if not fits:
        raise typer.Exit(1)


def examine(
    files: Annotated[list[Path], Argument(help="Capture files of one camera.")],
    psf: Annotated[Path | None, Option(help="Image of their measured PSF.")] = None,
    bits: Bits = None,
    bayer: Bayer = None,
    strict: Strict = False,
) -> None:
    """Look for faults in captures and their PSF."""
    with reported(lambda: "interrupted; nothing is known of the files"):
        from thincam_jax.measured import Preparation, read_image
        from thincam_jax.measured.examination import examine as examined

        captures = [read_image(path, bits=bits) for path in files]
        light = None if psf is None else read_image(psf, bits=bits)
        found = examined(captures, light, Preparation(bayer=bayer)).findings
    lines = [f"{'severe: ' if one.severe else ''}{one}" for one in found]
    say_result("findings", [vars(one) for one in found], "\n".join(lines) or "nothing found")
    if strict and any(one.severe for one in found):
        raise typer.Exit(WRONG_INPUT)
