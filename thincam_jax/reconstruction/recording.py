"""Captures with all that is known of how they were taken."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import Model
from thincam_jax.reconstruction.arguments import FILTERS, METHODS, Settings, require
from thincam_jax.reconstruction.build import camera_problem, object_pitch, psf_problem
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.regularised import Solved, middle
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.spectra import Prior


class Recording(NamedTuple):
    """What is reconstructed from; each as in `reconstruct`."""

    captures: Float[Array, "capture *batch y x"]
    cameras: Sequence[LenslessCamera] | Array
    object_distance: Any = None
    wavelength: Any = None
    noise_variance: Any = None
    synthesis: Any = None
    field_shape: tuple[int, int] | None = None
    valid: Any = None
    prior: Prior = "inverse_square"
    model: Model = "separable"
    pixel_integration: bool = True

    @property
    def has_cameras(self) -> bool:
        """Or else measured PSFs."""
        return isinstance(self.cameras, Sequence)


def check_recording(method: str, recording: Recording) -> None:
    """Filters are made of cameras, and measured PSFs stand for all that describes those."""
    if method in FILTERS:
        known_cameras(recording, method)
    if recording.has_cameras:
        return
    names = ("object_distance", "wavelength", "synthesis")
    unused = [name for name in names if getattr(recording, name) is not None]
    if unused:
        raise ValueError(
            f"measured PSFs cannot use {' and '.join(unused)}; leave out, or give cameras"
        )


def known_cameras(recording: Recording, method: str) -> Sequence[LenslessCamera]:
    """The cameras, or an error that says what does without them."""
    if isinstance(recording.cameras, Sequence):
        return recording.cameras
    *others, last = [repr(m) for m in METHODS if m not in (*FILTERS, "auto")]
    raise ValueError(
        f"method {method!r} needs cameras; with measured PSFs use {', '.join(others)} or {last}"
    )


def problem_of(method: str, recording: Recording, settings: Settings) -> Deconvolution:
    """What an iterative method is to minimise."""
    cameras = recording.cameras
    how = {
        "tau": settings.number,
        "noise_variance": recording.noise_variance,
        "field_shape": recording.field_shape,
        "valid": recording.valid,
        "variation": settings.variation,
        "nonnegative": True if settings.nonnegative is None else settings.nonnegative,
    }
    if not isinstance(cameras, Sequence):
        return psf_problem(recording.captures, cameras, **how)
    require(method, object_distance=recording.object_distance, wavelength=recording.wavelength)
    return camera_problem(
        recording.captures,
        cameras,
        wavelength=recording.wavelength,
        object_distance=recording.object_distance,
        synthesis=recording.synthesis,
        model=recording.model,
        pixel_integration=recording.pixel_integration,
        **how,
    )


def upright(recording: Recording, image):
    """An image as the scene is: cameras turn it over; the other way it is the same."""
    if image is None or not recording.has_cameras:
        return image
    return jnp.asarray(image)[..., ::-1, ::-1]


def reconstruction(
    recording: Recording, problem: Deconvolution, solved: Solved, method: str, tau
) -> Reconstruction:
    """The image with the axes of the captures, upright, and how it came about.

    `tau`: the relative one that the problem was built with; None for methods without.
    """
    captures, outcome = recording.captures, solved.outcome
    pitch, shape = None, problem.field_shape
    if isinstance(recording.cameras, Sequence):
        pitch = object_pitch(recording.cameras, recording.object_distance)
    elif recording.field_shape is None:
        shape = captures.shape[-2:]  # the part in front of the sensor
    image = upright(recording, middle(outcome.image, shape))
    planes, batch = image.shape[-3], captures.shape[1:-2]
    image = image.reshape(*batch, *((planes,) if planes > 1 else ()), *image.shape[-2:])
    return Reconstruction(
        image,
        pitch,
        method,
        ending=outcome.status,
        history=outcome.history,
        iterations=outcome.iterations,
        seconds=outcome.seconds,
        tau=None if tau is None else float(tau) * solved.tau_factor,
    )
