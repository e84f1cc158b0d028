"""Images of a rig's frames, in grey or, of a Bayer mosaic, in colour."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.imaging.encoding import as_picture
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.lensless.mosaic import Mosaic
from thincam_jax.measured.bayer import Pattern, colour_sites, demosaic, demosaic_mask
from thincam_jax.reconstruction.methods import reconstruct
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.wiener import Wiener
from thincam_jax.studies.evaluate import cameras_of, coupled
from thincam_jax.studies.study import Method, Study

FrameSolver = Callable[[Float[np.ndarray, "capture y x"]], Reconstruction]
_SHARES = 1 / 4, 1 / 2, 1 / 4  # of the pixels of a Bayer pattern


def frame_solver(
    study: Study,
    width: float,
    variance: Float[np.ndarray, "y x"] | None = None,
    bayer: Pattern | None = None,
) -> FrameSolver:
    """The function that reconstructs frames (capture, y, x) by the method of a study.

    - `width`: width of the square object that the image covers, mm.
    - `variance`: variance of each pixel of a frame, infinite where it is not known; AdmmTV takes
      the mean and leaves those out, of a single frame. Else the noise is estimated from the frames.
    - `bayer`: pattern of the frames. They are demosaiced by linear interpolation, and the study has
      a method each for red, green and blue.
    """
    first = study.methods[0]
    if not isinstance(first.solver, AdmmTV) or len(first.exposures) > 1:
        variance = None
    shares = _SHARES if bayer else (1.0,)
    pairs = zip(study.methods, shares, strict=True)
    solvers = [_solver_of(study, method, width, share) for method, share in pairs]

    mosaic = mosaic_of(study)

    def solved(frames: Float[np.ndarray, "frame v u"]) -> Reconstruction:
        if mosaic is not None:
            frames = np.stack(mosaic.split(np.asarray(frames[0])))
        pairs = zip(solvers, _channels(frames, variance, bayer), strict=True)
        found = [solve(*channel) for solve, channel in pairs]
        last = max(found, key=lambda one: one.iterations)
        return replace(last, image=jnp.concatenate([one.image for one in found]))

    return solved


def mosaic_of(study: Study) -> Mosaic | None:
    """The masks side by side whose captures are parts of one frame, of a study that has them."""
    one = study.methods[0].exposures[0]
    return None if one.part is None else one.part.mosaic(study.sensor, study.mask)


def _channels(
    frames: Float[np.ndarray, "capture y x"],
    variance: Float[np.ndarray, "y x"] | None,
    bayer: Pattern | None,
) -> Iterator[tuple[Array, Array, np.ndarray | None]]:
    """Captures (capture, 1, y, x) of each colour, variance of a pixel and pixels to trust."""
    shape, colours, valid = frames.shape[1:], frames[..., None], None
    sites, step = [np.ones(shape, bool)], 1
    if bayer is not None:
        colours = np.stack([demosaic(frame, bayer) for frame in frames])
        sites, step = list(colour_sites(shape, bayer).values()), 2
    if variance is not None:
        valid = np.isfinite(variance)
        noise = [jnp.asarray(variance[valid & site].mean(), jnp.float32) for site in sites]
        valid = valid[..., None] if bayer is None else ~demosaic_mask(~valid, bayer)
    else:
        # The first pixel of each colour; others are two apart.
        corners = [np.unravel_index(site.argmax(), shape) for site in sites]
        parts = [jnp.asarray(frames[:, y::step, x::step], jnp.float32) for y, x in corners]
        noise = [estimate_variance(part)[:, None] for part in parts]
    for number in range(len(sites)):
        captures = jnp.asarray(colours[:, None, ..., number], jnp.float32)
        yield captures, noise[number], None if valid is None else valid[..., number]


def _solver_of(
    study: Study, method: Method, width: float, share: float
) -> Callable[..., Reconstruction]:
    """Function of captures, the variance of a pixel's noise and the pixels to trust: an image.

    - `share`: share of the pixels that see the method's colour. Interpolated, their noise has a
      spectrum that falls from variance/share, which the filter takes; total variation is better off
      with the variance itself.
    """
    cameras = cameras_of(study, method, square_field(study, width), study.object_distance)
    solver: Any = coupled(method.solver, 1)
    if hasattr(solver, "synthesis"):
        solver = replace(solver, synthesis=method.synthesis_matrix)
    prepared = solver.prepare(cameras) if isinstance(solver, Wiener) else None

    def solved(captures: Array, variance: Array, valid: np.ndarray | None) -> Reconstruction:
        if prepared is not None:
            return prepared(captures, variance / share)
        recording = Recording(captures, cameras, noise_variance=variance, valid=valid)
        return reconstruct(recording, solver)

    return solved


def square_field(study: Study, width: float) -> tuple[int, int]:
    """Pixels of the image of a square object of so many mm, by a study's first method."""
    side = max(1, round(width * study.methods[0].distance / study.object_distance / study.pitch))
    return side, side


def live_image(
    study: Study, width: float, bayer: Pattern | None = None
) -> Callable[[Float[np.ndarray, "y x"]], np.ndarray]:
    """The function that makes an image, levels 0 to 1, of one frame of a study's first exposure.

    By a Wiener filter, fast enough for a picture of what a camera sees now: without fringe scanning
    a zone plate's background and twin image stay. `bayer`: see `frame_solver`.
    """
    methods = []
    for number, method in enumerate(study.methods):
        if method.exposures.layout is not None:  # all in a frame
            methods.append(replace(method, name=f"live {number}", solver=Wiener()))
            continue
        one = method.exposures[0]
        light = {"wavelength": one.wavelength, "width": one.width, "profile": one.profile}
        first = Exposures(one.beta, one.distance, phase=one.phase, **light)
        methods.append(Method(f"live {number}", first, Wiener()))
    solve = frame_solver(replace(study, methods=tuple(methods)), width, bayer=bayer)

    def levels(frame: Float[np.ndarray, "y x"]) -> np.ndarray:
        image = as_picture(np.asarray(solve(frame[None]).image))
        low, high = np.quantile(image, (0.002, 0.998))
        return (image - low) / max(high - low, 1e-30)

    return levels
