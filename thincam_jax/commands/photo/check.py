"""Whether a PSF is that of a capture, from their files."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp

from thincam_jax.commands.photo.options import Sources
from thincam_jax.commands.photo.run import Rig
from thincam_jax.measured import MeasurementError
from thincam_jax.reconstruction import Psfs, Recording, check_psf

_SIDE = 160  # pixels, about, of the longer side: enough to tell half a per cent


def check_files(
    sources: Sources, capture: Path, search: float, told: Callable[[int, int], object]
) -> tuple[list[str], bool]:
    """What `check_psf` says of two files, in lines, and whether the PSF fits."""
    rig = Rig(sources)
    ready = rig.prepare(capture)
    shape = ready.capture.shape[-2:]
    recording = Recording(
        jnp.asarray(ready.capture)[None],
        Psfs(jnp.asarray(ready.psf)[None]),
        valid=jnp.asarray(ready.valid)[None],
    )
    try:
        found = check_psf(recording, search=search, callback=told)
    except ValueError as error:
        raise MeasurementError(str(error)) from None
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
    preparation = dataclasses.replace(sources.preparation, downsample=max(1, round(pixels / _SIDE)))
    return dataclasses.replace(sources, preparation=preparation)
