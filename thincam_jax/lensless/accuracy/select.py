"""The cheapest model that meets a tolerance, with its error predicted and the reasons in words."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain, islice, takewhile

import jax

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Position
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import Cost, available_bytes
from thincam_jax._core.precision import PRECISIONS, RESULT_ROUNDING, precision_of
from thincam_jax.lensless.accuracy.probe import MaskProbe
from thincam_jax.lensless.accuracy.sampled import sampled_errors
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask, has_few_terms
from thincam_jax.lensless.method import (
    SAMPLED,
    Model,
    PsfMethod,
    as_method,
    models_of,
    parts_of,
    psf_method,
    sampled_off_axis,
)
from thincam_jax.lensless.propagation.skew import corner_error
from thincam_jax.lensless.resolve import held_in_single, psf_cost, require_off_axis

# Predictions are estimates from some rows and columns (or pixels, for the direct sum): what they
# are multiplied with so that they stay above the true error, found over 500 random cameras.
_MARGIN = {"angular_spectrum": 1.4, "rayleigh_sommerfeld": 1.8}
_MARGIN_CLOSED = 1.25
# Operations that fit into the time of going to another precision and back, some 0.4 ms.
_CONVERSION = 1e7


@dataclass(frozen=True)
class Prediction:
    """Error and cost of a model.

    - `method`: model with its settings, which `psf` takes in place of the model's name.
    - `predicted_error`: relative L2 over the sensor, at least the true one in 99 % of cameras.
    - `cost`: operations and peak memory.
    """

    method: PsfMethod
    predicted_error: float
    cost: Cost


@dataclass(frozen=True)
class Selection(Prediction):
    """The choice of `choose_model`.

    - `meets_tolerance`: False if no model does; the choice is then the most accurate.
    - `paraxial_error`: estimate of how far exact scalar diffraction is from the Fresnel field that
      errors are counted from.
    - `reasons`: one sentence for every effect left out, with its size.
    - `considered`: the predictions that the choice was made from, cheapest first.
    """

    meets_tolerance: bool
    paraxial_error: float
    reasons: tuple[str, ...]
    considered: tuple[Prediction, ...]


@checked
def choose_model(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    tolerance: float,
    pixel_integration: bool = True,
) -> Selection:
    r"""The cheapest model and precision whose PSF is within `tolerance` of the best one.

    The error is relative, ‖h − h₀‖₂/‖h₀‖₂ over the pixels of the sensor, against the best model of
    the mask: `separable` in double precision, the exact Fresnel field of the aperture. It is
    predicted from one-dimensional fields: on some hundred rows and columns the factors of every
    model are compared with those of the reference, and the norm of the whole image follows from
    their Gram matrices. No image is computed.

    How far Fresnel's approximation itself is from exact scalar diffraction is given separately, in
    `paraxial_error` and in the reasons: it is common to all the closed forms, is mostly the fringes
    far from the aperture's edges, and falls by orders of magnitude with `pixel_integration`.

    Masks without separable terms, such as phase masks, have no exact PSF. For them the choice is
    among samples a pixel of `angular_spectrum`, by what more of them change in the mask's middle;
    for masks of more than 128 terms and of rings, whose field is exact, among points of the
    pixel's average (`thincam_jax.lensless.accuracy.sampled`). How far Fresnel's approximation is
    from exact diffraction is not estimated for these.

    **Arguments**: `wavelength`, `object_distance` and `pixel_integration` as for `psf`;
    `tolerance` > 0. Numbers must be known: call it outside of jit and grad.

    **Errors**: ValueError for what is out of range; TypeError for traced numbers.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    choice = tc.choose_model(camera, wavelength=500 * nm, object_distance=250.0, tolerance=0.1)
    h = tc.psf(camera, wavelength=500 * nm, object_distance=250.0, model=choice.method)
    ```

    **See also**: `predict_error`, `plan_capture`, `psf`.
    """
    tolerance = checks.relative_tolerance(tolerance)
    mask, grid = camera.mask, camera.sensor.grid
    if has_few_terms(mask):
        probe = probe_of(camera, wavelength, object_distance, pixel_integration)
        ways = candidates(mask, grid, pixel_integration)
        found = ((method, predicted_error(probe, mask, grid, method)) for method in ways)
    else:
        probe, path = None, camera.path(wavelength, object_distance)
        _require_known((camera, path))
        finer = sampled_errors(mask, grid, path, pixel_integration)
        found = chain(islice(finer, 1), takewhile(lambda way: _fits(mask, grid, way[0]), finer))
    considered = [
        Prediction(method, error, psf_cost(mask, grid, method))
        for method, error in until_met(found, tolerance)
    ]
    chosen = min(considered, key=lambda one: one.predicted_error)
    if considered[-1].predicted_error <= tolerance:
        chosen = considered[-1]
    if probe is None:
        paraxial_error, reasons = _sampled_reasons(mask, chosen)
    else:
        paraxial_error = probe.paraxial_error()
        reasons = _reasons(probe, chosen, paraxial_error)
    return Selection(
        **vars(chosen),
        meets_tolerance=chosen.predicted_error <= tolerance,
        paraxial_error=paraxial_error,
        reasons=reasons,
        considered=tuple(considered),
    )


def until_met(
    found: Iterable[tuple[PsfMethod, float]], tolerance: float
) -> list[tuple[PsfMethod, float]]:
    """Methods with their errors, the cheapest first, up to the first within the tolerance."""
    considered = []
    for method, error in found:
        considered.append((method, error))
        if error <= tolerance:
            break
    return considered


@checked
def predict_error(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    at: Position | None = None,
    model: Model | PsfMethod,
    pixel_integration: bool = True,
) -> Prediction:
    """Predicted error and cost of one model; arguments as for `psf`, reference as for
    `choose_model`.

    `at` is for "separable" and "geometric", against the exact field to second order about the ray.
    Off both axes the waves of a plate's corners count, which it leaves out (`corner_error`).

    **Errors**: as `choose_model`; ValueError for samples off the axis, by which "separable" has
    cells off both axes.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    found = tc.predict_error(camera, wavelength=500 * nm, object_distance=250.0, model="geometric")
    print(found.predicted_error > 0.01)  # True
    ```

    **See also**: `choose_model`.
    """
    average = as_method(model, pixel_integration).pixel_integration
    probe = probe_of(camera, wavelength, object_distance, average, at)
    grid, path = camera.sensor.grid, camera.path(wavelength, object_distance, at)
    method = sampled_off_axis(camera.mask, grid, path, as_method(model))
    method = psf_method(camera.mask, grid, method, average)
    require_off_axis(camera.mask, path, method.model)
    if at is not None and method.model in SAMPLED:
        raise ValueError(
            f"errors of samples ({method.model!r}) are predicted on the axis only: leave `at` out, "
            "or compare psf with itself at more oversampling"
        )
    error = predicted_error(probe, camera.mask, grid, method)
    if path.skew and method.model == "separable":
        error += corner_error(camera.mask, path, float(grid.pitch) * average)
    return Prediction(method, error, psf_cost(camera.mask, grid, method))


def predict_cost(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod,
    pixel_integration: bool = True,
) -> tuple[Cost, float | None]:
    """Cost of a PSF before it is computed, and its predicted error; arguments as for `psf`.

    The error is None for masks that are no short sum of products, which only sampling tells.
    """
    how = {"model": model, "pixel_integration": pixel_integration}
    if has_few_terms(camera.mask):
        light = {"wavelength": wavelength, "object_distance": object_distance}
        found = predict_error(camera, **light, **how)
        return found.cost, found.predicted_error
    grid = camera.sensor.grid
    return psf_cost(camera.mask, grid, psf_method(camera.mask, grid, **how)), None


def _fits(mask: AbstractMask, grid: Grid, method: PsfMethod) -> bool:
    """Whether a PSF fits into the memory that is free."""
    free = available_bytes()
    return free is None or psf_cost(mask, grid, method).bytes <= free


def _sampled_reasons(mask: AbstractMask, chosen: Prediction) -> tuple[float, tuple[str, ...]]:
    """The paraxial error and the reasons for a mask without a short sum of terms."""
    method, left = chosen.method, f"{chosen.predicted_error:.1e}"
    if mask.exact_model is None:
        return 0.0, (
            f"a {type(mask).__name__} has no exact PSF: of 'angular_spectrum' with "
            f"{method.samples}×{method.samples} samples a pixel, the mask's middle with more "
            f"of them differs so that {left} is left; far behind a small mask "
            "most of that is cut off by the window, and a larger mask_shape of psf cuts less",
            "errors are counted from scalar diffraction without Fresnel's approximation",
        )
    averaged = f", a pixel's average by {method.nodes} points: {left}" if method.nodes else ""
    return math.nan, (
        f"{mask.exact_model!r} adds up the field of the mask's {parts_of(mask)}{averaged}",
        "errors are counted from the exact Fresnel field",
    )


def _require_known(numbers) -> None:
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves(numbers)):
        raise TypeError(
            "the choice of a model needs known numbers: make it outside of jit and grad"
        )


def probe_of(
    camera: LenslessCamera,
    wavelength: Number,
    object_distance: Number,
    pixel_integration: bool,
    at: Position | None = None,
) -> MaskProbe:
    """The probe of a camera whose numbers are known, off both axes with products of both."""
    mask = camera.mask
    if not has_few_terms(mask):
        raise TypeError(
            "choose_model needs a mask of few separable terms, such as FresnelZoneAperture; "
            f"for this {type(mask).__name__} choose 'angular_spectrum' or 'rayleigh_sommerfeld' "
            "and their oversampling yourself"
        )
    path = replace(camera.path(wavelength, object_distance, at), skew=False)
    grid = camera.sensor.grid
    _require_known((camera, path, grid))
    return MaskProbe(mask, grid, path, pixel_integration=pixel_integration)


def candidates(mask: AbstractMask, grid: Grid, pixel_integration: bool) -> list[PsfMethod]:
    """Candidates that fit into memory, cheapest first, up to the reference."""
    own = precision_of(grid.pitch)

    def time(method: PsfMethod) -> float:
        # An operation in double precision takes about two in single.
        operations = psf_cost(mask, grid, method).flops * (1 + (method.precision == "float64"))
        return operations + (0.0 if method.precision == own else _CONVERSION)

    methods = (
        psf_method(mask, grid, PsfMethod(model, precision), pixel_integration)
        for model in models_of(mask)
        for precision in PRECISIONS
    )
    fitting = sorted((m for m in methods if _fits(mask, grid, m)), key=time)
    reference = PsfMethod("separable", "float64", pixel_integration)
    return fitting[: fitting.index(reference) + 1] if reference in fitting else fitting


def predicted_error(probe: MaskProbe, mask: AbstractMask, grid: Grid, method: PsfMethod) -> float:
    """Relative L2 error of a PSF, with the margin that keeps it above the true one."""
    model, precision = method.model, method.float_type
    if precision == "float32" and not held_in_single(mask, grid, probe.path, model):
        return math.inf  # `psf` refuses it
    if model == "angular_spectrum":
        return _MARGIN[model] * probe.angular_spectrum(method)
    if model == "rayleigh_sommerfeld":
        return _MARGIN[model] * probe.rayleigh_sommerfeld(method)
    if model == "closed_form" and probe.in_focus():
        return math.inf  # `psf` refuses it
    error = probe.model_error(model, method.nodes) + probe.rounding(model, precision)
    return _MARGIN_CLOSED * error + RESULT_ROUNDING[precision_of(grid.pitch)]


def _reasons(probe: MaskProbe, chosen: Prediction, paraxial_error: float) -> tuple[str, ...]:
    """Effects that the chosen model leaves out, in words and numbers."""
    fresnel = (
        "errors are counted from the exact Fresnel field; exact scalar diffraction differs from "
        f"that by about {paraxial_error:.1e}"
    )
    method = chosen.method
    if method.oversampling is not None:
        return (
            f"the mask is held by {method.samples}×{method.samples} samples a pixel, and "
            "the phases are exact where 'separable' has Fresnel's: together "
            f"{chosen.predicted_error:.1e}",
            fresnel,
        )
    size = probe.rounding(method.model, method.float_type)
    phase = probe.numbers().largest_phase
    rounding = f"{method.precision} rounds phases of up to {phase:.1e} rad: {size:.1e}"
    return (*_optics_left_out(probe, method.model), rounding, fresnel)


def _optics_left_out(probe: MaskProbe, model: Model) -> list[str]:
    """Diffraction and edges that a closed form leaves out, in the steps of the ladder."""
    numbers = probe.numbers()
    zone = f"an edge zone of √(λd/M) = {numbers.edge_zone * 1e3:.3g} µm"
    if model == "geometric":
        size = probe.model_error("geometric")
        bent = ""
        if numbers.epsilon:
            phase = f"up to {numbers.first_order:.2g} rad at the mask's edge"
            bent = f"ε = {numbers.epsilon:.2g}, {phase}; "
        return [f"diffraction is left out ({bent}{zone}): {size:.1e}"]
    if model == "separable":
        if not probe.pixel_integration:
            return []
        size = probe.model_error("separable")
        return [f"a pixel's average is taken at up to {probe.nodes} points an axis: {size:.1e}"]
    edge = probe.model_error("closed_form")
    effects = [f"the aperture's edge is left out ({zone}): {edge:.1e}"]
    if model == "paraxial":
        second = probe.difference("paraxial", "closed_form")
        effects.insert(
            0,
            f"diffraction of second order in ε = {numbers.epsilon:.2g} is left out (up to "
            f"{numbers.second_order:.2g} rad at the mask's edge): {second:.1e}",
        )
    return effects
