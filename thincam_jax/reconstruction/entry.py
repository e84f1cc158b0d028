"""`reconstruct`: the one entry point."""

import dataclasses
from collections.abc import Sequence
from typing import get_args

from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import MODELS, Model
from thincam_jax.reconstruction.arguments import METHODS as METHODS
from thincam_jax.reconstruction.arguments import Method as Method
from thincam_jax.reconstruction.arguments import (
    Settings,
    cameras_or_psfs,
    check_settings,
    floating_captures,
)
from thincam_jax.reconstruction.automatic import choose_method
from thincam_jax.reconstruction.drive import Callback
from thincam_jax.reconstruction.families import by_method
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.recording import Recording, check_recording
from thincam_jax.reconstruction.regularised import Acceleration
from thincam_jax.reconstruction.regulariser import AbstractRegulariser
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.spectra import Prior
from thincam_jax.reconstruction.total_variation import TotalVariation


def reconstruct(
    captures: Float[Array, "capture *batch y x"] | Sequence[Float[Array, "*batch y x"]],
    cameras: Sequence[LenslessCamera] | Float[Array, "capture *planes k l"],
    *,
    method: Method = "wiener",
    object_distance=None,
    wavelength=None,
    noise_variance=None,
    synthesis=None,
    field_shape: tuple[int, int] | None = None,
    prior: Prior = "inverse_square",
    tau=None,
    variation: TotalVariation | None = None,
    regulariser: AbstractRegulariser | None = None,
    ridge=None,
    background=None,
    nonnegative: bool | None = None,
    valid=None,
    iterations: int | None = None,
    tolerance: float | None = None,
    relaxation: float | None = None,
    acceleration: Acceleration | None = None,
    start: Float[Array, "*image rows columns"] | None = None,
    callback: Callback | None = None,
    model: Model = "separable",
    pixel_integration: bool = True,
) -> Reconstruction:
    """The image of a scene from captures of it.

    **Arguments**

    - `captures`: (capture, *batch, y, x), one for each camera. But for the filters the last batch
      axis is the colour channel.
    - `cameras`: what took them; or measured PSFs on the same pixels, an array (capture, k, l),
      (capture, channel, k, l) or (capture, channel, plane, k, l).
    - `method`: "wiener" (see `WienerSynthesis`, which needs `wavelength` and `noise_variance`),
      "fringe_scanning" (see `FringeScanning`, which uses neither), "admm_tv" (total variation by
      ADMM, which models the crop of the sensor; see `thincam_jax.reconstruction.admm`), "fista" or
      "twist" (the same minimiser by proximal gradients, which have no penalties to choose and are
      slower), "ridge" (the posterior mean under a white prior, with the crop, linear; the image may
      be negative), "poisson" (total variation for captures that are counts, few of them a pixel),
      or "auto", which picks "wiener" or "admm_tv" and gives its `reason`.
    - `object_distance`: t, mm, on which to focus; several (not the filters) give a plane each.
    - `noise_variance`: one number, or one for each capture; all but wiener estimate it where it is
      not given. Not for poisson, which knows it.
    - `synthesis`: sums of captures, default each by itself; see
      `thincam_jax.reconstruction.synthesis`. Not for poisson: sums are no counts.
    - `field_shape`, `prior`, `model`, `pixel_integration`: see `WienerSynthesis`. With PSFs the
      field is by default all that sends light to the sensor, and the image the part in front of it.

    The rest is refused where the method cannot use it; "auto" takes what one of its methods uses.
    What describes camera and scene (the arguments above) is not: it may serve several methods.

    - `tau` (admm_tv, fista, twist, poisson): weight of the variation relative to the noise, about 1
      to 3, default 2; see `absolute_tau`. For poisson the noise is that of the mean count.
      "discrepancy" or "sure" find it, in some ten times the time, for Gaussian noise; see
      `choose_tau`.
    - `variation` (the same): its kind and coupling, see `TotalVariation`.
    - `regulariser` (fista, twist): in its place, such as `Sparsity` in wavelets or cosines, with
      the same τ: a coefficient of an orthonormal basis has the noise of a pixel.
    - `ridge` (ridge): noise variance over image variance, in parts of what the captures' mean
      brightness makes of it, default 1; see `bayesian.absolute_ridge`.
    - `background` (poisson): dark counts within the captures, one number, or for each capture one
      number or one a pixel; default none.
    - `nonnegative` (admm_tv, fista, twist): ask for f ≥ 0, default True.
    - `valid` (all but the filters): mask of the pixels to trust, (capture, *batch, y, x).
    - `iterations` (the same): at most, default 100; 300 for ridge and poisson. `tolerance`: on the
      relative residuals or steps of the method, default 1e-4.
    - `relaxation` (admm_tv): 0 < α < 2, default 1.8. `acceleration` (admm_tv): "none", the default,
      or "anderson", which mixes the last five points; fewer iterations where nothing is relaxed,
      but each takes several times as long, and ten copies of the state are kept.
    - `start` (admm_tv, fista, twist, poisson): a first image, such as an earlier result. By default
      an even one with cameras and for poisson, else a black one. Where it is given admm_tv has no
      first part without the even light, see docs/reconstruction.md.
    - `callback` (admm_tv, fista, twist): called with `Progress` every tenth iteration; a true
      answer stops the run. Ctrl-C returns the best image so far, with status "interrupted".

    To reconstruct many scenes with the same cameras by Wiener or fringe scanning build
    `WienerSynthesis` or `FringeScanning` once and call it. Under jit, grad or vmap use
    `thincam_jax.reconstruction.solve_fixed_point`.

    **Errors**: ValueError, one line, for captures that do not fit the cameras, for unknown
    methods, models and priors, and for arguments that the method cannot use.
    """
    checks.choice("method", method, METHODS)
    taken_by = cameras_or_psfs(cameras)
    recording = Recording(
        captures=floating_captures(captures, len(taken_by)),
        cameras=taken_by,
        object_distance=object_distance,
        wavelength=wavelength,
        noise_variance=noise_variance,
        synthesis=synthesis,
        field_shape=field_shape,
        valid=valid,
        prior=prior,
        model=model,
        pixel_integration=pixel_integration,
    )
    settings = Settings(
        tau=tau,
        variation=variation,
        regulariser=regulariser,
        ridge=ridge,
        background=background,
        nonnegative=nonnegative,
        iterations=iterations,
        tolerance=tolerance,
        relaxation=relaxation,
        acceleration=acceleration,
        start=start,
        callback=callback,
    )
    _check(method, recording, settings)
    if method == "auto":
        return _by_choice(recording, settings)
    return by_method(method, recording, settings)


def _check(method: str, recording: Recording, settings: Settings) -> None:
    """Whether a method, what is known of the captures and the settings go together."""
    checks.choice("prior", recording.prior, get_args(Prior))
    checks.choice("model", recording.model, MODELS)
    check_recording(method, recording)
    check_settings(
        method,
        settings,
        valid=recording.valid,
        noise_variance=recording.noise_variance,
        synthesis=recording.synthesis,
    )


def _by_choice(recording: Recording, settings: Settings) -> Reconstruction:
    """By the method that suits the captures; what only the others can use is left aside."""
    method, reason = choose_method(
        recording.captures,
        recording.cameras,
        recording.synthesis,
        recording.noise_variance,
        valid=recording.valid,
        object_distance=recording.object_distance,
    )
    if method == "wiener" and recording.noise_variance is None:
        recording = recording._replace(noise_variance=estimate_variance(recording.captures))
    return dataclasses.replace(by_method(method, recording, settings), reason=reason)
