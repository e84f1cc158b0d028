r"""`fit_psf`: the numbers of a camera from a picture of a point source."""

import math
from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.precision import Precision, allow, cast, precision_of
from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import quantities, unchecked
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.measured.calibration.coarse import (
    covariance_by_differences,
    full_image,
    slope_norms,
)
from thincam_jax.measured.calibration.problem import (
    CONVERGED,
    STEP,
    FitProblem,
    FitState,
    Solution,
    Status,
    Synthesis,
    ambiguous_pairs,
    of_values,
    solve,
    state_and_residual,
    unknown_names,
    values_by_steps,
    verdict,
)
from thincam_jax.measured.calibration.start import PsfSearch, check_fringes, given, start_near
from thincam_jax.measured.raw import image_with_contrast

Weights = Mapping[float, complex | float | int]
# The phase and weight of each capture of a fringe-scanned one, as in `fringe_scanned_otf`.
FRINGE_SCANNED = {0.0: 1j, math.pi / 2: -1.0, math.pi: -1j, 3 * math.pi / 2: 1.0}
# Part of the image's contrast that a fit must explain; less is another picture, or another turn.
_EXPLAINED = 0.5
_BACKWARDS = "the phases run backwards: fitted with the negative of each; correct their order"
# What has a relative error, and those up to which it is known. The parts of an image whose residual
# is noise agree within a third of what noise explains; a blur or a shading brings a few times that,
# and moves d by several of its errors.
_POSITIVE = ("beta", "width", "distance", "object_distance", "wavelength")
_KNOWN, _KNOWN_BY_PARTS, _DISAGREE = 0.03, 0.005, 1.5


# Of what can be fitted; of a centre, (y, x) are two numbers.
_QUANTITIES = quantities(FresnelZoneAperture, LenslessCamera, LightPath)
_QUANTITIES |= dict.fromkeys(("centre_x", "centre_y"), _QUANTITIES["centre"])


class PsfFit(Module):
    """Result of `fit_psf`.

    - `camera`: the camera with the fitted numbers, in the precision of the one given.
    - `object_distance`: t, mm; `wavelength`: λ, mm; `background` and `gain`: image = background +
      gain·h, in the image's unit.
    - `names`: the numbers that were fitted, the order of `correlation`.
    - `values`, `standard_errors`: value and error of each of them, in mm, rad/mm², rad and the
      image's unit. The errors are those of white noise of the residual's own strength,
      √(σ²(JᵀJ)⁻¹), or those by which 64 parts of the image disagree, where that is more: the
      residual is then not noise, and what the model leaves out may have moved the numbers further
      still.
    - `correlation`: correlation of their errors from noise.
    - `residual`: measured − model, (y, x); complex where the image is.
    - `status`: "ok"; "ambiguous", where the image does not hold a number: two cannot be told apart
      (`AMBIGUOUS`: a correlation above 0.999), the error of one is above 3 %, above 0.5 % where the
      residual is not noise, or it left its search; "poor_fit", where the model explains less than
      half of the image's contrast; "not_converged", where the last ten steps of the least squares
      moved a number by more than a tenth of its standard error. The first that applies, from the
      last to the first.
    - `reasons`: one line for each thing that is not as it should be.
    - `iterations`: number of iterations of the least squares.
    """

    camera: LenslessCamera
    object_distance: Float[Array, ""] = eqx.field(converter=unchecked("mm"))
    wavelength: Float[Array, ""] = eqx.field(converter=unchecked("mm"))
    background: Float[Array, ""]
    gain: Float[Array, ""]
    values: dict[str, Float[Array, ""]] = eqx.field(converter=unchecked(parts=_QUANTITIES))
    standard_errors: dict[str, Float[Array, ""]] = eqx.field(converter=unchecked(parts=_QUANTITIES))
    correlation: Float[Array, "unknown unknown"]
    residual: Inexact[Array, "y x"]
    names: tuple[str, ...] = eqx.field(static=True)
    status: Status = eqx.field(static=True)
    reasons: tuple[str, ...] = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    @property
    def centre_pixels(self) -> Float[Array, "2"]:
        """(y, x) of the mask's centre in pixels from the middle of the sensor."""
        return self.camera.mask.centre / self.camera.sensor.pitch


@checked
@watched("fitting the PSF")
def fit_psf(
    psf_image: Numbers | Inexact[ArrayLike, "y x"],
    camera: LenslessCamera,
    *,
    weights: Weights | None = None,
    object_distance: Number,
    wavelength: Number,
    search: PsfSearch | None = None,
) -> PsfFit:
    r"""Fit the exact PSF of a zone aperture to a measured one, by least squares.

    .. math::
        \min \sum_{y,x} \big[ g_{yx} - B - G\,h(y, x;\,\beta, \varphi, y_0, x_0, W, d, t, \lambda)
        \big]^2

    with h of the model "separable". A matched filter for chirps (`calibrate.chirp_search`) finds
    β, the mask's centre, φ and d to a fraction of a fringe first, from numbers some 10 % off;
    Levenberg-Marquardt then fits all pixels. In double precision, whatever the camera's.

    **What a PSF can tell.** Scaling mask and distances leaves a picture unchanged: on the sensor h
    depends on φ, β/M², M·centre, M·W and λdM only, with M = 1 + d/t.

    - d follows from diffraction, ε = βλd/(πM), if λ is known; λ and d cannot both be fitted where
      t = ∞, nor λ, d and t at a finite t.
    - β and t follow from M², thus from M·W, if the width W is known and the rims of the shadow, or
      the ripples that they throw, are on the sensor; else only β/M².
    - β, t and W never all three.

    `status` and `reasons` name the numbers that the data do not separate, by their correlations;
    these are then one of many equally good choices.

    There is no tilt of the mask against the sensor. Turned by α about the y axis, the mask is
    foreshortened, which changes the fringes' phase by βx²α² and would keep h separable; but its
    halves are also magnified and diffracted differently, some 2βr²·αx/t and εβr²·αx/d, which does
    not. At 1° on the thesis' camera that is 0.06, 0.16 and 0.08 rad in the corners: a fit of the
    foreshortening alone would take the others for it. A tilt shows in `residual`, as fringes whose
    contrast grows towards the rim.

    **Arguments**

    - `psf_image`: (y, x) on the camera's sensor, linear in irradiance, in any unit.
    - `weights`: weights of a picture that is a sum Σ w_k g_k of captures at several phases: each
      phase φ_k (rad, on top of the mask's) and its w_k. A complex picture without is fringe-scanned
      as the thesis does, (g(3π/2) − g(π/2)) + j(g(0) − g(π)): `FRINGE_SCANNED`. Where the weights
      add up to 0 there is no background left, and none is fitted. Where the picture is explained
      only by the negative phases, these are fitted and `reasons` says that the phases run
      backwards.
    - `camera`: with a `FresnelZoneAperture`; its numbers are the start.
    - `object_distance`: t, mm, from the mask, or infinity; `wavelength`: λ, mm.
    - `search`: the numbers to fit, and how far from the camera's; by default `PsfSearch()`.

    **Validity.** That of the Fresnel approximation. The search needs ε < 0.5; beyond, least squares
    start from the camera as given. A start of "width" must be within some √(λd) of the truth.

    **Errors**: ValueError or TypeError, one line, for an image that is not finite, has no contrast
    or another shape than the sensor, a sensor that holds less than one fringe, unknown parameters
    and another mask.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask, sensor = tc.FresnelZoneAperture(30.0, width=2.0), tc.Sensor((112, 133), 20 * um)
    true, nominal = (tc.LenslessCamera(mask, sensor, d) for d in (3.1, 3.0))
    light = {"wavelength": 500 * nm, "object_distance": 100.0}
    image = tc.psf(true, pixel_integration=True, **light)
    fit = tc.fit_psf(image, nominal, **light)
    print(fit.status, round(float(fit.values["distance"]), 2))  # ok 3.1
    ```

    **See also**: `check_psf`.
    """
    search = PsfSearch() if search is None else search
    synthesis = _check_weights(psf_image, weights)
    if synthesis is not None and not np.any(np.abs(synthesis.weights.sum(axis=1)) > 1e-6):
        left = tuple(name for name in search.parameters if name != "background")
        search = replace(search, parameters=left)
    image = _check_image(psf_image, camera, synthesis)
    with allow("float64", camera):
        double = cast((camera, synthesis), "float64")
        guess = given(double[0], object_distance, wavelength, search, double[1])
        check_fringes(guess)
        start = start_near(image, guess, search)
        names, average = unknown_names(search.parameters), search.pixel_integration
        backwards = ""
        if double[1] is not None and _explained(image, start, average) < _EXPLAINED:
            turned = eqx.tree_at(lambda state: state.synthesis.phases, guess, -double[1].phases)
            other = start_near(image, turned, search)
            if _explained(image, other, average) >= _EXPLAINED:
                start, guess, backwards = other, turned, _BACKWARDS
        problem = _problem(image, start, names, average)
        known, _ = covariance_by_differences(full_image(image, start, average), start, names)
        solution = solve(problem, known.standard_errors, search.max_steps)
        fit = _report(problem, solution, guess, search, precision_of(camera.distance))
    return replace(fit, reasons=(backwards, *fit.reasons)) if backwards else fit


def _check_weights(image, weights: Weights | None) -> Synthesis | None:
    """Assembly of the picture; None for one capture."""
    is_complex = np.iscomplexobj(image)
    if weights is None and not is_complex:
        return None
    weights = FRINGE_SCANNED if weights is None else weights
    phases, factors = np.array(list(weights), float), np.array(list(weights.values()), complex)
    turns = np.exp(1j * phases)
    left = np.abs([factors @ turns, factors @ turns.conj()]) if weights else np.zeros(1)
    if not (np.isfinite(left).all() and left.max() > 1e-6 * np.abs(factors).sum()):
        raise ValueError(
            f"weights = {dict(weights)!r} leave no fringes; give each capture's phase in rad and "
            "its finite weight, as {0.0: 1, math.pi: -1}"
        )
    real, imaginary = np.real(factors), np.imag(factors)
    if np.any(imaginary) and not is_complex:
        raise ValueError("weights are complex and psf_image is real; give the complex picture")
    parts = np.stack([real, imaginary][: 1 + is_complex])
    return Synthesis(jnp.asarray(phases), jnp.asarray(parts))


def _check_image(image, camera: LenslessCamera, synthesis: Synthesis | None) -> np.ndarray:
    if not isinstance(camera.mask, FresnelZoneAperture):
        raise TypeError(
            f"fit_psf fits a FresnelZoneAperture; the camera's mask is a "
            f"{type(camera.mask).__name__}"
        )
    if camera.mask.height is not None:
        raise ValueError("fit_psf fits square masks; leave the height out where it is the width")
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves((image, camera))):
        raise TypeError(
            "fit_psf searches, so that it cannot be traced: call it outside jit and grad"
        )
    parts = (np.real(image), np.imag(image))[: 1 + np.iscomplexobj(image)]
    seen = [image_with_contrast("psf_image", p, camera.sensor.shape, "the sensor") for p in parts]
    return seen[0] if synthesis is None else np.stack(seen)


def _explained(image: np.ndarray, state: FitState, pixel_integration: bool) -> float:
    """Part of the image's contrast that a state explains."""
    measured = full_image(image, state, pixel_integration)
    model = measured.model(state, ("phase",), np.zeros(1)).reshape(image.shape)
    return 1 - float(np.sum((model - image) ** 2) / np.sum((image - image.mean()) ** 2))


def _problem(image, start: FitState, names, pixel_integration: bool) -> FitProblem:
    contrast = np.linalg.norm(image - image.mean())
    scale = STEP * contrast / slope_norms(full_image(image, start, pixel_integration), start, names)
    weight = jnp.asarray(1 / contrast, jnp.float64)
    return FitProblem(
        start, jnp.asarray(image), weight, jnp.asarray(scale), names, pixel_integration
    )


def _report(
    problem: FitProblem,
    solution: Solution,
    guess: FitState,
    search: PsfSearch,
    precision: Precision,
) -> PsfFit:
    names = problem.names
    found, residual = state_and_residual(solution.scaled, problem)
    measured = full_image(np.asarray(problem.image), found, problem.pixel_integration)
    slopes = np.array(values_by_steps(found, names, jnp.zeros(len(names))))
    slopes[np.array(names) == "object_distance"] *= -1  # t falls where 1/t grows
    steps = covariance_by_differences(measured, found, names)
    known, parts = (of_values(of_steps, slopes) for of_steps in steps)
    values = dict(zip(names, np.asarray(found.values(names)), strict=True))
    errors = np.maximum(known.standard_errors, parts.standard_errors)
    disagree = errors > _DISAGREE * known.standard_errors
    errors, disagree = (dict(zip(names, each, strict=True)) for each in (errors, disagree))
    distance, alike = np.inf, ambiguous_pairs(names, known.correlation)
    nearness = float(found.nearness)
    if nearness > 0:
        distance = 1 / nearness
    if "object_distance" in names:
        values["object_distance"] = distance
        if not any("object_distance" in line for line in alike):
            alike += _too_far(nearness, errors["object_distance"])
        errors["object_distance"] = errors["object_distance"] * distance**2
    alike += _unknown(values, errors, disagree)
    alike += _left_search(values, errors, guess, search.relative)
    explained = 1 - float(jnp.sum((residual * problem.weight) ** 2))
    poor = unfinished = ""
    if not explained >= _EXPLAINED:
        poor = (
            f"the model explains {max(0.0, explained):.0%} of the image's contrast: it is not "
            "this camera's PSF, too noisy, or further from the start than the search reaches"
        )
    if not np.all(solution.moved < CONVERGED):
        last = int(np.argmax(solution.moved))
        unfinished = (
            f"least squares stopped after {solution.iterations} steps, while {names[last]} moved "
            f"by {solution.moved[last]:.2g} of its standard error; try max_steps"
        )
    status, reasons = verdict(alike, poor, unfinished)
    if found.synthesis is not None:
        residual = residual[0] if len(residual) == 1 else jax.lax.complex(*residual)
    found_fit = PsfFit(
        found.camera,
        jnp.asarray(distance),
        found.wavelength,
        found.background,
        found.gain,
        {name: jnp.asarray(value) for name, value in values.items()},
        {name: jnp.asarray(error) for name, error in errors.items()},
        jnp.asarray(known.correlation),
        residual,
        names,
        status,
        reasons,
        solution.iterations,
    )
    return cast(found_fit, precision)


def _too_far(nearness: float, error: float) -> list[str]:
    """Warning for a point whose 1/t may as well be zero."""
    if nearness > 2 * error:
        return []
    nearest = 1 / (max(nearness, 0.0) + 2 * error) if error > 0 else math.inf
    return [
        f"object_distance may be infinite: the image says only that it is over {nearest:.3g} mm"
    ]


def _unknown(values, errors, disagree) -> list[str]:
    """One line for each number that the image knows too little of."""
    found = []
    for name in (n for n in _POSITIVE if n in values):
        part = float(errors[name] / values[name])
        if disagree[name] and part > _KNOWN_BY_PARTS:
            found.append(
                f"{name} is uncertain by more than {part:.1%}: parts of the image disagree by more "
                "than noise explains, so that the model leaves something out (blur, shading, tilt);"
                " measure it otherwise and fix it"
            )
        elif part > _KNOWN:
            found.append(f"{name} is known to {part:.1%} only: fix it, or give less noise")
    return found


def _left_search(values, errors, guess: FitState, search: float) -> list[str]:
    """One line for each number that ended beyond its search; a search of 0 holds nothing."""
    names = tuple(n for n in ("beta", "distance", "wavelength") if n in values and search > 0)
    return [
        f"{name} = {float(values[name]):.4g} has left the search of {search:.0%} around "
        f"{float(first):.4g}: the image does not hold it; fix it, or start nearer"
        for name, first in zip(names, guess.values(names), strict=True)
        if abs(values[name] - first) > search * first + 2 * errors[name]
    ]
