"""`reconstruct` once its method is settled: one function for each family of methods."""

from collections.abc import Sequence
from typing import cast

from thincam_jax.reconstruction.arguments import (
    DEFAULT_RELAXATION,
    DEFAULT_RIDGE,
    FILTERS,
    Settings,
    require,
)
from thincam_jax.reconstruction.bayesian import check_one_scale, poisson_outcome, ridge_outcome
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.recording import (
    Recording,
    known_cameras,
    problem_of,
    reconstruction,
    upright,
)
from thincam_jax.reconstruction.regularised import (
    Iterative,
    Options,
    Solved,
    TauRule,
    even_level,
    minimise,
)
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.synthesis import separate
from thincam_jax.reconstruction.wiener import WienerSynthesis


def by_method(method: str, recording: Recording, settings: Settings) -> Reconstruction:
    """The image by any method but "auto"; the settings of other methods are not looked at."""
    if method in FILTERS:
        return filtered(method, recording)
    if method == "ridge":
        return by_ridge(recording, settings)
    if method == "poisson":
        return by_poisson(recording, settings)
    return regularised(cast(Iterative, method), recording, settings)


def filtered(method: str, recording: Recording) -> Reconstruction:
    """In closed form, by a filter made of the cameras."""
    cameras = known_cameras(recording, method)
    require(method, object_distance=recording.object_distance)
    where = {
        "object_distance": recording.object_distance,
        "field_shape": recording.field_shape,
    }
    if method == "fringe_scanning":
        result = FringeScanning(cameras, **where)(recording.captures)
        return Reconstruction(result.image, result.pitch, method)
    require(method, wavelength=recording.wavelength, noise_variance=recording.noise_variance)
    synthesis = recording.synthesis
    filtering = WienerSynthesis(
        cameras,
        wavelength=recording.wavelength,
        synthesis=separate(len(cameras)) if synthesis is None else synthesis,
        prior=recording.prior,
        model=recording.model,
        pixel_integration=recording.pixel_integration,
        **where,
    )
    result = filtering(recording.captures, recording.noise_variance)
    return Reconstruction(result.image, result.pitch, method)


def regularised(method: Iterative, recording: Recording, settings: Settings) -> Reconstruction:
    """By iterations for total variation or another regulariser, from an even image or zero."""
    problem = problem_of(method, recording, settings)
    relaxation = settings.relaxation
    options = Options(
        method=method,
        iterations=settings.at_most(100),
        tolerance=settings.limit,
        relaxation=DEFAULT_RELAXATION if relaxation is None else relaxation,
        start=upright(recording, settings.start),
        callback=settings.callback,
        rule=cast(TauRule | None, settings.rule),  # checked with the settings
        regulariser=settings.regulariser,
        acceleration="none" if settings.acceleration is None else settings.acceleration,
    )
    solved = minimise(problem, options, even_start=recording.has_cameras)
    return reconstruction(recording, problem, solved, method, settings.number)


def by_ridge(recording: Recording, settings: Settings) -> Reconstruction:
    """The posterior mean under a white prior."""
    problem = problem_of("ridge", recording, settings)
    # Sums in which the even light cancels do not tell how bright the scene is; the captures do.
    plain = problem
    if recording.synthesis is not None:
        plain = problem_of("ridge", recording._replace(synthesis=None), settings)
    outcome = ridge_outcome(
        problem,
        even_level(plain),
        ridge=DEFAULT_RIDGE if settings.ridge is None else settings.ridge,
        iterations=settings.at_most(300),
        tolerance=settings.limit,
    )
    return reconstruction(recording, problem, Solved(outcome), "ridge", None)


def by_poisson(recording: Recording, settings: Settings) -> Reconstruction:
    """Total variation for captures that are counts."""
    if isinstance(recording.cameras, Sequence):
        check_one_scale(recording.cameras)
    # The variance is that of the counts; no other needs to be estimated.
    problem = problem_of("poisson", recording._replace(noise_variance=1.0), settings)
    outcome = poisson_outcome(
        problem,
        tau=settings.number,
        background=settings.background,
        start=upright(recording, settings.start),
        iterations=settings.at_most(300),
        tolerance=settings.limit,
    )
    return reconstruction(recording, problem, Solved(outcome), "poisson", settings.number)
