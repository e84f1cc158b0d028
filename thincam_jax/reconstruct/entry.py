"""`reconstruct`: the one entry point."""

from collections.abc import Sequence
from typing import Literal, cast, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax import _checks
from thincam_jax.camera import LenslessCamera
from thincam_jax.psf import MODELS, Model
from thincam_jax.reconstruct.automatic import are_cameras, choose_method
from thincam_jax.reconstruct.build import camera_problem, object_pitch, psf_problem
from thincam_jax.reconstruct.drive import Callback
from thincam_jax.reconstruct.fringe_scanning import FringeScanning
from thincam_jax.reconstruct.noise import estimate_variance
from thincam_jax.reconstruct.regularised import (
    Iterative,
    Options,
    Solved,
    TauRule,
    middle,
    minimise,
)
from thincam_jax.reconstruct.result import Reconstruction
from thincam_jax.reconstruct.spectra import Prior
from thincam_jax.reconstruct.synthesis import separate
from thincam_jax.reconstruct.total_variation import TotalVariation
from thincam_jax.reconstruct.wiener import WienerSynthesis

Method = Literal["auto", "wiener", "fringe_scanning", "admm_tv", "fista", "twist"]
METHODS: tuple[Method, ...] = get_args(Method)


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
    tau=2.0,
    variation: TotalVariation | None = None,
    nonnegative: bool = True,
    valid=None,
    iterations: int = 100,
    tolerance: float = 1e-4,
    relaxation: float = 1.8,
    start: Float[Array, "*image rows columns"] | None = None,
    callback: Callback | None = None,
    model: Model = "separable",
    pixel_integration: bool = True,
) -> Reconstruction:
    """The image of a scene from captures of it.

    **Arguments**

    - `captures`: (capture, *batch, y, x), one for each camera. With total variation the last batch
      axis is the colour channel.
    - `cameras`: what took them; or measured PSFs on the same pixels, an array (capture, k, l),
      (capture, channel, k, l) or (capture, channel, plane, k, l).
    - `method`: "wiener" (see `WienerSynthesis`, which needs `wavelength` and `noise_variance`),
      "fringe_scanning" (see `FringeScanning`, which uses neither), "admm_tv" (total variation by
      ADMM, which models the crop of the sensor; see `thincam_jax.reconstruct.admm`), "fista" or
      "twist" (the same minimiser by proximal gradients, which have no penalties to choose and are
      slower), or "auto", which picks one and gives its `reason`.
    - `object_distance`: t, mm, on which to focus; several (admm_tv) give a plane each.
    - `noise_variance`: one number, or one for each capture; admm_tv estimates it where it is not
      given.
    - `synthesis`: sums of captures, default each by itself; see
      `thincam_jax.reconstruct.synthesis`.
    - `field_shape`, `prior`, `model`, `pixel_integration`: see `WienerSynthesis`. With PSFs the
      field is by default all that sends light to the sensor, and the image the part in front of it.

    For admm_tv, fista and twist:

    - `tau`: weight of the variation relative to the noise, about 1 to 3; see `absolute_tau`.
      "discrepancy" or "sure" find it, in some ten times the time; see `choose_tau`.
    - `variation`: its kind and coupling, see `TotalVariation`.
    - `nonnegative`: ask for f ≥ 0. `valid`: mask of the pixels to trust, (capture, *batch, y, x).
    - `iterations`: at most; `tolerance`: on the relative primal and dual residuals.
    - `relaxation`: of admm_tv, 0 < α < 2. `start`: a first image, such as an earlier result.
    - `callback`: called with `Progress` every tenth iteration; a true answer stops the run. Ctrl-C
      returns the best image so far, with status "interrupted".

    To reconstruct many scenes with the same cameras by Wiener or fringe scanning build
    `WienerSynthesis` or `FringeScanning` once and call it. Under jit, grad or vmap use
    `thincam_jax.reconstruct.solve_fixed_point`.

    **Errors**: ValueError, one line, for captures that do not fit the cameras and for unknown
    methods, models and priors.
    """
    _checks.choice("method", method, METHODS)
    cameras = _cameras_or_psfs(cameras)
    captures = _captures(captures, len(cameras))
    reason = ""
    if method == "auto":
        chosen, reason = choose_method(
            captures,
            cameras,
            synthesis,
            noise_variance,
            valid=valid,
            object_distance=object_distance,
        )
        method = cast(Method, chosen)
        if method == "wiener" and noise_variance is None:
            noise_variance = estimate_variance(captures)
    _checks.choice("prior", prior, get_args(Prior))
    _checks.choice("model", model, MODELS)
    if method not in ("wiener", "fringe_scanning"):
        rule = cast(TauRule, tau) if isinstance(tau, str) else None
        tau = 2.0 if isinstance(tau, str) else tau
        chosen = cast(Iterative, method)
        how = Options(chosen, iterations, tolerance, relaxation, start, callback, rule)
        if not isinstance(cameras, Sequence):
            _refuse(
                "measured PSFs",
                object_distance=object_distance,
                wavelength=wavelength,
                synthesis=synthesis,
            )
            problem = psf_problem(
                captures,
                cameras,
                tau=tau,
                noise_variance=noise_variance,
                field_shape=field_shape,
                valid=valid,
                variation=variation,
                nonnegative=nonnegative,
            )
            shape = captures.shape[-2:] if field_shape is None else problem.field_shape
            outcome = minimise(problem, how, even_start=False)
            return _result(outcome, captures, shape, None, method, reason, tau)
        _require(method, object_distance=object_distance, wavelength=wavelength)
        problem = camera_problem(
            captures,
            cameras,
            wavelength=wavelength,
            object_distance=object_distance,
            tau=tau,
            noise_variance=noise_variance,
            synthesis=synthesis,
            field_shape=field_shape,
            valid=valid,
            variation=variation,
            nonnegative=nonnegative,
            model=model,
            pixel_integration=pixel_integration,
        )
        turned = None if start is None else jnp.asarray(start)[..., ::-1, ::-1]
        outcome = minimise(problem, how._replace(start=turned), even_start=True)
        pitch = object_pitch(cameras, object_distance)
        return _result(outcome, captures, problem.field_shape, pitch, method, reason, tau)
    if not isinstance(cameras, Sequence):
        raise ValueError(
            f"method {method!r} needs cameras; with measured PSFs use 'admm_tv', 'fista' or 'twist'"
        )
    _refuse(f"method {method!r}", valid=valid, variation=variation, start=start, callback=callback)
    _require(method, object_distance=object_distance)
    if method == "fringe_scanning":
        scanning = FringeScanning(cameras, object_distance=object_distance, field_shape=field_shape)
        return _named(scanning(captures), method, reason)
    _require(method, wavelength=wavelength, noise_variance=noise_variance)
    filtering = WienerSynthesis(
        cameras,
        wavelength=wavelength,
        object_distance=object_distance,
        synthesis=separate(len(cameras)) if synthesis is None else synthesis,
        field_shape=field_shape,
        prior=prior,
        model=model,
        pixel_integration=pixel_integration,
    )
    return _named(filtering(captures, noise_variance), method, reason)


_UNITS = {"object_distance": "mm", "wavelength": "mm", "noise_variance": "units²"}


def _cameras_or_psfs(cameras) -> Sequence[LenslessCamera] | Array:
    if isinstance(cameras, LenslessCamera):
        raise TypeError("cameras is one camera; give a list, [camera], one for each capture")
    if are_cameras(cameras):
        return cameras
    psfs = jnp.asarray(cameras)
    if psfs.ndim < 3:
        raise ValueError(
            f"PSFs have shape {psfs.shape}; give (capture, k, l), such as psf[None] for one"
        )
    return psfs


def _refuse(what: str, **given) -> None:
    """The answer would be to another question than was asked."""
    unused = [name for name, value in given.items() if value is not None]
    if unused:
        raise ValueError(f"{what} cannot use {' and '.join(unused)}; leave out, or use 'admm_tv'")


def _require(method: str, **given) -> None:
    missing = [f"{name} ({_UNITS[name]})" for name, value in given.items() if value is None]
    if missing:
        raise ValueError(f"method {method!r} needs {' and '.join(missing)}")


def _captures(captures, count: int) -> Float[Array, "capture *batch y x"]:
    captures = jnp.asarray(captures)
    if not jnp.issubdtype(captures.dtype, jnp.floating):
        captures = captures.astype(float)
    if captures.ndim < 3 or captures.shape[0] != count:
        raise ValueError(
            f"captures have shape {captures.shape} for {count} cameras; give ({count}, …, y, x)"
        )
    return captures


def _named(result: Reconstruction, method: str, reason: str) -> Reconstruction:
    return Reconstruction(result.image, result.pitch, method, reason)


def _result(
    solved: Solved, captures, shape, pitch, method: str, reason: str, tau
) -> Reconstruction:
    """The image with the axes of the captures; upright if cameras turned it over."""
    outcome = solved.outcome
    image = middle(outcome.image, shape)
    image = image if pitch is None else image[..., ::-1, ::-1]
    planes = image.shape[-3]
    batch = captures.shape[1:-2]
    image = image.reshape(*batch, *((planes,) if planes > 1 else ()), *image.shape[-2:])
    return Reconstruction(
        image,
        pitch,
        method,
        reason,
        outcome.status,
        outcome.history,
        outcome.iterations,
        outcome.seconds,
        float(tau) * solved.tau_factor,
    )
