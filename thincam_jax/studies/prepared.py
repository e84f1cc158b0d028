"""Reconstruct captures that `measured.prepare` made of files, with a measured PSF."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core.arguments import any_rank
from thincam_jax._core.grids import same_parity
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.imaging.operators.crop_convolution import centred_crop, window_shape
from thincam_jax.lensless.psf import psf
from thincam_jax.measured import MeasurementError, Raw
from thincam_jax.measured.preparation import Prepared
from thincam_jax.reconstruction import AbstractSolver, InverseProblem
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs
from thincam_jax.reconstruction.iterate import Callback, Progress
from thincam_jax.reconstruction.methods import solved
from thincam_jax.reconstruction.noise import demosaiced_noise, estimate_variance
from thincam_jax.reconstruction.problem import relative_residual
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AbstractRegularised
from thincam_jax.reconstruction.result import Reconstruction

# Real arrays of the window's size that a reconstruction holds at its peak, for each channel.
_WINDOWS = 28


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a prepared pixel.

    - `deviation`: standard deviation in the unit of the prepared capture; `counts`: that in counts
      of a raw pixel.
    - `found`: origin of the number, in words.
    """

    deviation: float
    counts: float
    found: str


@any_rank
def pixel_noise(prepared: Prepared, counts: float | None = None) -> PixelNoise:
    """Noise of a prepared capture: of raw `counts`, by a sensor's calibration, or estimated."""
    log, how = prepared.log, "given"
    if counts is None and log.capture.noise is not None:
        counts, how = log.capture.noise, "photon and read noise by the sensor's calibration"
    # One count of a raw pixel in units of the prepared capture.
    of_a_count = 1 / (log.capture.full_scale * log.options.downsample * log.capture_divisor)
    if counts is not None:
        noise = counts * of_a_count
        return PixelNoise(noise, noise / of_a_count, how)
    how = "estimated from the finest detail at each brightness"
    light, valid = (jnp.asarray(array) for array in (prepared.capture, prepared.valid))
    noise = 0.0
    if log.options.bayer is not None and log.options.demosaicing == "bilinear":
        noise = float(demosaiced_noise(light, valid))
    if noise > 0:
        how = f"{how}, in every second pixel of each colour"
    else:
        noise = float(jnp.sqrt(estimate_variance([light], [valid])[0]))
    return PixelNoise(noise, noise / of_a_count, how)


def computed_psf(cameras: Cameras, name: str) -> Raw:
    """PSF of a camera as a measured one, also beyond the sensor where the shadow is larger.

    `name`: words before the numbers of the camera and its light.
    """
    (camera,), wavelength, distance = cameras.cameras, cameras.wavelength, cameras.object_distance
    how = {"model": cameras.model, "pixel_integration": cameras.pixel_integration}
    grid, fringe = camera.sensor.grid, 2 * math.sqrt(wavelength * float(camera.distance))
    shadow = np.asarray(camera.mask.extent) * (1 + float(camera.distance) / distance) + fringe
    pixels = np.ceil(shadow / float(grid.pitch)).astype(int)
    shape = same_parity(np.maximum(pixels, grid.shape).tolist(), grid.shape)
    wide = camera.on_grid(grid.with_shape(shape))
    image = psf(wide, wavelength=wavelength, object_distance=distance, **how)
    numbers = eqx.tree_pformat(camera, width=10_000)  # in one line
    light = f"wavelength {wavelength * 1e6:g} nm, object at {distance:g} mm"
    name = f"{name}: {numbers}, {light}"
    return Raw(np.asarray(image), name=name, sensor_shape=camera.sensor.shape)


def prepared_recording(prepared: Prepared, noise: PixelNoise | None = None) -> Recording:
    """A prepared capture and its PSF as a recording.

    - `noise`: see `pixel_noise`; None: estimated by each solver. With it the field is all that
      sends light to the sensor.
    """
    # The mask is given even where all is valid, so that one compilation serves a whole folder.
    arrays = prepared.capture, prepared.psf, prepared.valid
    capture, psf, valid = (jnp.asarray(array)[None] for array in arrays)
    if noise is None:
        return Recording(capture, Psfs(psf), valid=valid)
    psfs = Psfs(psf, field_shape=_field(prepared))
    return Recording(capture, psfs, valid=valid, noise_variance=noise.deviation**2)


def _field(prepared: Prepared) -> tuple[int, int]:
    sizes = zip(prepared.capture.shape[-2:], prepared.psf.shape[-2:], strict=True)
    rows, columns = (n + k - 1 for n, k in sizes)
    return rows, columns


@dataclass(frozen=True)
class PreparedFacts:
    """Reconstruction of a prepared capture; `history` of the steps that were reported."""

    method: str
    noise_standard_deviation: float
    field_shape: tuple[int, int]
    iterations: int
    status: str
    relative_data_residual: float
    history: tuple[Progress, ...]
    seconds: float


def check_channels(prepared: Prepared, name: str) -> None:
    """Refuse a channel in which nothing can be seen; `name`: name of the capture in messages.

    **Errors**: MeasurementError, one line.
    """
    if not (prepared.valid & (prepared.capture > 0)).any(axis=(1, 2)).all():
        raise MeasurementError(
            f"{name}: has a channel without a trusted pixel that holds light; all others are "
            "saturated or dead: give a larger saturation, or expose less"
        )


@dataclass(frozen=True, eq=False)
class PreparedResult:
    """The reconstruction of a prepared capture, over all that sends light to the sensor."""

    recording: Recording
    solver: AbstractSolver
    found: Reconstruction
    noise: PixelNoise

    def image(
        self, field: Literal["sensor", "full"] = "sensor"
    ) -> Float[np.ndarray, "channel y x"]:
        """The image in float32: the part in front of the sensor, or all of it."""
        sensor = self.recording.captures[0].shape[-2:]
        image = self.found.image
        image = image if field == "full" else centred_crop(image, sensor)
        return np.asarray(image, dtype=np.float32)

    @cached_property
    def problem(self) -> InverseProblem:
        """The least-squares problem that was solved."""
        if isinstance(self.solver, AbstractRegularised):
            return self.recording.problem(tau=self.solver.tau, regulariser=self.solver.prior)
        return self.recording.problem(tau=2.0, nonnegative=False)

    @property
    def facts(self) -> "PreparedFacts":
        """Solver, status and steps in a line."""
        found = self.found
        return PreparedFacts(
            found.method,
            self.pixel_deviation,
            self.problem.field_shape,
            found.iterations,
            found.status,
            self.relative_residual,
            tuple(found.history),
            round(found.seconds, 3),
        )

    @property
    def pixel_deviation(self) -> float:
        """Standard deviation of the noise of a trusted pixel, whose weight is 1/σ²."""
        return float(1 / jnp.sqrt(jnp.max(self.problem.weights[0])))

    @property
    def relative_residual(self) -> float:
        """Norm of the residual over that of the capture."""
        return float(relative_residual(self.problem, self.found.image[:, None]))


@any_rank
def reconstruct_prepared(
    prepared: Prepared,
    solver: AbstractSolver,
    noise: PixelNoise,
    *,
    callback: Callback | None = None,
    name: str = "the capture",
) -> PreparedResult:
    """Reconstruct all that sends light to the sensor, every channel of a prepared capture.

    - `noise`: see `pixel_noise`. `callback`: see `tc.reconstruct`.
    - `name`: name of the capture, for messages.

    ```python
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.measured import Raw, prepare
    from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared

    random = np.random.default_rng(0)
    psf, capture = (Raw(random.integers(40, 4000, (40, 48, 1)).astype(np.uint16)) for _ in "ab")
    prepared = prepare(psf, capture, background=40.0)
    found = reconstruct_prepared(prepared, tc.AdmmTV(iterations=5), pixel_noise(prepared))
    image = found.image()  # (channel, y, x)
    ```

    **Errors**: MemoryError, one line, where it would take more than is free.
    """
    channels, *sensor = prepared.capture.shape
    sensor, field = (sensor[0], sensor[1]), _field(prepared)
    window = window_shape(sensor, field, prepared.psf.shape[-2:])
    refuse_if_too_large(
        f"{name}: its reconstruction on {window[0]}×{window[1]} samples",
        4 * _WINDOWS * channels * window[0] * window[1],
        "give a larger downsample",
    )
    recording = prepared_recording(prepared, noise)
    found = solved(recording, solver, callback=callback)
    return PreparedResult(recording, solver, found, noise)
