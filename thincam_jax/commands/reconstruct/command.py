"""The command `thincam reconstruct`."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from thincam_jax.commands.reconstruct import METHODS
from thincam_jax.commands.terminal import WRONG_INPUT, Overrides, reported, say_result

Psf = Annotated[Path, Option(help="Measured PSF: TIFF, PNG or NPY.")]
Background = Annotated[
    str | None, Option(help="Dark frame, a folder of one each, counts, corner or (default) found.")
]
PsfBackground = Annotated[
    str | None, Option(help="That of the PSF, where it was exposed otherwise.")
]
Bits = Annotated[int | None, Option(help="Bit depth, as 12 where 16 are stored.")]
PsfBits = Annotated[int | None, Option(help="That of the PSF, where it is another.")]
Corner = Annotated[str, Option(help="Rows and columns of the PSF's dark corner, FIRST:AFTER_LAST.")]
PsfScale = Annotated[
    float | None,
    Option(help="Enlarge the PSF, of any size: pitch of its pixels over the capture's."),
]
PsfChannels = Annotated[
    Literal["each", "mean"], Option(help="each: a PSF for each colour; mean: one for all.")
]
Crop = Annotated[
    str | None,
    Option(help="Rows and columns of the captures to use, as 100:740,200:1000. The PSF is whole."),
]
Bayer = Annotated[
    Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None,
    Option(help="Colours of the mosaic, from its upper left."),
]
Strict = Annotated[bool, Option("--strict", help="Severe findings are errors: exit code 2.")]
Dead = Annotated[Path | None, Option(help="Map of dead pixels, not zero where dead.")]


def reconstruct(
    capture: Annotated[list[Path], Option(help="Capture, or a folder; several: its exposures.")],
    out: Annotated[
        Path, Option(help="Image (.png, .npy, .tif); a folder for a folder of captures.")
    ],
    psf: Annotated[list[Path] | None, Option(help="Measured PSF; several: its exposures.")] = None,
    exposure: Annotated[
        list[str] | None, Option(help="As 4ms, of each exposure whose file does not say it.")
    ] = None,
    distances: Annotated[
        str | None,
        Option(help="60mm,80mm,100mm: refocus; --psf is a folder or TIFF of a PSF for each."),
    ] = None,
    camera: Annotated[
        Path | None,
        Option(help="In place of --psf, a study (YAML) whose first shot took the capture."),
    ] = None,
    network: Annotated[
        Path | None,
        Option(help="Of 'thincam train' for that camera, or 'shipped', in place of a method."),
    ] = None,
    distance: Annotated[
        str | None, Option(help="To focus a network on, as 120mm. Default: the study's object.")
    ] = None,
    set_: Overrides = None,
    background: Background = None,
    psf_background: PsfBackground = None,
    downsample: Annotated[int, Option(help="Side of the blocks of pixels that are averaged.")] = 1,
    bits: Bits = None,
    psf_bits: PsfBits = None,
    corner: Corner = "5:15",
    psf_scale: PsfScale = None,
    crop: Crop = None,
    bayer: Bayer = None,
    demosaic: Annotated[
        Literal["bilinear", "superpixel"],
        Option(help="superpixel joins 2×2 pixels: half the size."),
    ] = "bilinear",
    dead: Dead = None,
    saturation: Annotated[
        float | None, Option(help="Saturated from this part of full scale on.")
    ] = None,
    noise_threshold: Annotated[
        float | None, Option(help="Set the PSF to 0 below so many times its noise.")
    ] = None,
    psf_channels: PsfChannels = "each",
    method: Annotated[
        str, Option(help=f"One of {', '.join(METHODS)}.", autocompletion=lambda: METHODS)
    ] = "admm-tv",
    tau: Annotated[
        float | None,
        Option(help="Weight of total variation relative to noise, about 1 to 3. Default: 2."),
    ] = None,
    ridge: Annotated[
        float | None,
        Option(help="Of ridge: noise over image variance, in parts of the expected. Default: 1."),
    ] = None,
    noise: Annotated[
        float | None,
        Option(help="Of a raw pixel, standard deviation in counts. Default: estimated."),
    ] = None,
    iterations: Annotated[
        int | None, Option(help="At most. Default: 300; of fista 100, pnp 5, ridge 1000.")
    ] = None,
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
    strict: Strict = False,
) -> None:
    """Reconstruct captures with a measured PSF, or with that of a camera's numbers.

    Takes one, or all of a folder. Writes the image, its linear values and a JSON record of all that
    was done. Ctrl-C keeps the best image so far.
    """
    nothing = "interrupted; of the capture at work no image is there yet, nothing of it is kept"
    with reported(lambda: nothing):
        from thincam_jax.commands.reconstruct import options
        from thincam_jax.commands.reconstruct.jobs import plan_jobs
        from thincam_jax.commands.reconstruct.run import run_with_bar
        from thincam_jax.measured import Preparation

        known, focusing = options.known_psf(psf or (), camera, set_, network, distance)
        sources = options.Sources(
            known,
            options.read_background(background),
            0.0 if camera else options.read_background(psf_background),
            dead,
            bits,
            Preparation(
                bayer=bayer,
                demosaicing=demosaic,
                downsample=downsample,
                corner=options.read_corner(corner),
                psf_scale=psf_scale,
                crop=options.read_crop(crop),
                saturation=saturation,
                noise_threshold=noise_threshold,
                psf_channels=psf_channels,
            ),
            psf_bits,
            options.read_distances(distances, psf or ()),
            options.read_exposures(exposure or (), len(psf or ()), len(capture)),
        )
        recipe = options.Recipe(
            method=method.replace("-", "_"),
            tau=tau,
            iterations=iterations,
            coupling=coupling,
            field=field,
            flip=flip,
            ridge=ridge,
            noise=noise,
            focusing=focusing,
            strict=strict,
        )
        balance, unsure = options.read_white_balance(white_balance), focusing is not None
        output = options.Output(out, linear, gamma, balance, unsure)
        jobs = plan_jobs(capture[0], sources, output, tuple(capture[1:]))
        end = run_with_bar(jobs, sources, recipe, output)
    if end:
        raise typer.Exit(end)


def check(
    psf: Psf,
    capture: Annotated[Path, Option(help="Capture of the same size.")],
    background: Background = None,
    psf_background: PsfBackground = None,
    downsample: Annotated[
        int | None,
        Option(help="Side of the blocks that are averaged. Default: 160 pixels stay, or 320."),
    ] = None,
    bits: Bits = None,
    psf_bits: PsfBits = None,
    corner: Corner = "5:15",
    psf_scale: PsfScale = None,
    crop: Crop = None,
    bayer: Bayer = None,
    dead: Dead = None,
    psf_channels: PsfChannels = "each",
    search: Annotated[float, Option(help="How far to look for the scale, parts of one.")] = 0.06,
    refine: Annotated[
        Path | None,
        Option(help="Write the PSF of the scale, turn and blur that fit best (.npy, .tif)."),
    ] = None,
) -> None:
    """Tell whether a PSF is that of a capture, and refine it.

    Tries other scales, turns and mirror images of it. The exit code is 1 if one of them fits
    better, unless --refine has written it.
    """
    with reported(lambda: "interrupted; nothing is known of the PSF"):
        from thincam_jax.commands.reconstruct import options
        from thincam_jax.commands.reconstruct.run import check_files, enough_blocks
        from thincam_jax.commands.terminal import progress_bar
        from thincam_jax.measured import Preparation

        sources = options.Sources(
            psf,
            options.read_background(background),
            options.read_background(psf_background),
            dead,
            bits,
            Preparation(
                bayer=bayer,
                downsample=1 if downsample is None else downsample,
                corner=options.read_corner(corner),
                psf_scale=psf_scale,
                crop=options.read_crop(crop),
                psf_channels=psf_channels,
            ),
            psf_bits,
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
    files: Annotated[list[Path], Argument(help="Captures of one camera.")],
    psf: Annotated[Path | None, Option(help="Their measured PSF.")] = None,
    bits: Bits = None,
    bayer: Bayer = None,
    strict: Strict = False,
) -> None:
    """Examine captures and a PSF for what spoils an image, without reconstructing any."""
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
