"""Errors and times of the PSF models of a study's camera: model, precision and oversampling.

Errors are relative, ‖h − h₀‖₂/‖h₀‖₂ over the sensor, against h₀ by separable in float64, the exact
Fresnel field.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Num

from thincam_jax._core.memory import available_bytes, readable
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast
from thincam_jax._core.steps import Step
from thincam_jax.lensless.accuracy.select import predicted_error, probe_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import Cost, psf_cost
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.method import SAMPLED, Model, PsfMethod, models_of, psf_method
from thincam_jax.lensless.propagation.closed_form import in_focus
from thincam_jax.lensless.psf import psf
from thincam_jax.studies.study import Study

OVERSAMPLINGS = (1, 3)
# Operations of a direct sum that take some seconds; it is not run beyond.
DIRECT_SUM_LIMIT = 2e10
# A median of at most so many calls, and no further one once they took so many seconds.
_MOST_CALLS, _SECONDS = 15, 0.5
# A call that takes longer than this needs no warming up: it is itself the measurement.
_LONG = 1.0
_GAIN = 0.05  # a smaller error by less than this part is no gain


def binned(study: Study, size: int) -> Study:
    """The study with its pixels binned so that the sensor's longer side has `size` of them.

    The pitch grows by the same ratio, so that the sensor keeps its area: along the longer side
    exactly, along the shorter one to half a pixel. The mask stays as it is.
    """
    ratio = max(study.sensor.shape) / size
    rows, columns = (max(1, round(n / ratio)) for n in study.sensor.shape)
    sensor = dataclasses.replace(study.sensor, shape=(rows, columns), pitch=study.pitch * ratio)
    return dataclasses.replace(study, sensor=sensor)


class Conditions(eqx.Module):
    """Camera, wavelength (mm) and object distance (mm) in one precision."""

    camera: LenslessCamera
    wavelength: Array
    object_distance: Array


def conditions_of(study: Study, exposure: Exposure) -> dict[Precision, Conditions]:
    """One exposure in each precision. The numbers are those of float32 in both.

    So a difference between the two is what the arithmetic leaves, not how the numbers are stored.
    """
    found: dict[Precision, Conditions] = {}
    with allow("float64"):
        numbers = (exposure.wavelength, study.object_distance)
        wavelength, distance = (jnp.asarray(np.float32(n)) for n in numbers)
        single = cast(study.camera(exposure), "float32")
        for precision in PRECISIONS:
            found[precision] = Conditions(*cast((single, wavelength, distance), precision))
    return found


def psf_of(
    study: Study,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    shape: tuple[int, int] | None = None,
) -> np.ndarray:
    """PSF on the sensor, or on `shape` of its pixels; by default the one that errors count from."""
    with allow(precision):
        given = conditions_of(study, exposure)[precision]
        grid = given.camera.sensor.grid
        h = psf(
            given.camera.on_grid(grid.with_shape(shape or grid.shape)),
            wavelength=given.wavelength,
            object_distance=float(given.object_distance),
            model=PsfMethod(model, precision, study.pixel_integration),
        )
    return np.asarray(h)


def relative_error(image: Num[ArrayLike, "..."], reference: Num[ArrayLike, "..."]) -> float:
    """‖image − reference‖₂ / ‖reference‖₂ over all numbers, real or complex."""
    image, reference = np.asarray(image, complex), np.asarray(reference, complex)
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def contrast_error(
    image: Num[ArrayLike, "*batch y x"], reference: Num[ArrayLike, "*batch y x"]
) -> float:
    """Relative error without each (y, x) image's mean: a capture's bias carries no picture."""
    contrasts = (np.asarray(a, float) for a in (image, reference))
    return relative_error(*(c - c.mean(axis=(-2, -1), keepdims=True) for c in contrasts))


def candidates(camera: LenslessCamera, pixel_integration: bool) -> list[tuple[PsfMethod, Cost]]:
    """Every model in both precisions, the sampled ones at each oversampling."""
    mask, grid = camera.mask, camera.sensor.grid
    methods = [
        psf_method(
            mask, grid, PsfMethod(model, precision, pixel_integration, oversampling=oversampling)
        )
        for model in models_of(mask)
        for oversampling in (OVERSAMPLINGS if model in SAMPLED else (None,))
        for precision in PRECISIONS
    ]
    return [(method, psf_cost(mask, grid, method)) for method in methods]


def why_not(model: Model, cost: Cost, given: Conditions) -> str | None:
    """Why a model is not run under given conditions; None where it is."""
    if model == "rayleigh_sommerfeld" and cost.flops > DIRECT_SUM_LIMIT:
        return f"a direct sum of {cost.flops:.1e} operations, above {DIRECT_SUM_LIMIT:.0e}"
    free = available_bytes()
    if free is not None and cost.bytes > free:
        return f"needs about {readable(cost.bytes)}, {readable(free)} are free"
    path = given.camera.path(given.wavelength, given.object_distance)
    if model == "closed_form" and in_focus(given.camera.mask, path):
        return "has no PSF: an order of the mask focuses on the sensor"
    return None


@dataclass(frozen=True)
class PsfAccuracy:
    """Error and time of a candidate on a sensor of a shape; None where it is not run.

    - `reason`: why it is not run.
    - `true_error`, `predicted_error`: relative.
    - `seconds`: median over `calls` of the compiled function; `compile_seconds`: tracing and
      compilation, once.
    - `flops`, `bytes`: estimated.
    - `worth_choosing`: nothing measured is both faster and more accurate.
    """

    shape: tuple[int, int]
    pitch_mm: float
    model: Model
    precision: Precision
    oversampling: int | None
    status: str
    reason: str | None
    true_error: float | None
    predicted_error: float | None
    seconds: float | None
    compile_seconds: float | None
    calls: int
    flops: float
    bytes: int
    worth_choosing: bool = False


class PsfErrors:
    """The candidates at one size: `work` fills `rows`.

    The reference is among them, but has no error to be worth choosing by.
    """

    def __init__(self, study: Study, exposure: Exposure, size: int):
        self.study, self.exposure = binned(study, size), exposure
        self._rows: list[PsfAccuracy] = []
        self.given = conditions_of(self.study, exposure)
        with allow("float64"):
            found = candidates(self.given["float64"].camera, study.pixel_integration)
        self.work = [
            Step(
                f"{size} pixels: {label(method.model, method.float_type, method.oversampling)}",
                partial(self._add, method, cost),
            )
            for method, cost in found
        ]

    @property
    def rows(self) -> list[PsfAccuracy]:
        """Rows of all candidates that are done."""
        measured = [row for row in self._rows if row.true_error]
        worth = pareto_front([(row.seconds or 0.0, row.true_error or 0.0) for row in measured])
        front = {id(row) for row, on_it in zip(measured, worth, strict=True) if on_it}
        return [dataclasses.replace(row, worth_choosing=id(row) in front) for row in self._rows]

    @cached_property
    def _exact(self) -> tuple[Any, np.ndarray]:
        """The probe that errors are predicted from, and the PSF that they count from."""
        given = self.given["float64"]
        numbers = given.camera, given.wavelength, given.object_distance
        probe = probe_of(*numbers, self.study.pixel_integration)
        return probe, psf_of(self.study, self.exposure)

    def _add(self, method: PsfMethod, cost: Cost) -> None:
        error = predicted = seconds = compile_seconds = None
        calls = 0
        with allow("float64"):
            exact = self.given["float64"]
            reason = why_not(method.model, cost, exact)
            if reason is None:
                probe, reference = self._exact
                mask, grid = exact.camera.mask, exact.camera.sensor.grid
                predicted = predicted_error(probe, mask, grid, method)
                timed = _measured(self.given[method.float_type], method)
                error = relative_error(timed.result, reference)
                seconds, compile_seconds, calls = timed.seconds, timed.compile_seconds, timed.calls
        self._rows.append(
            PsfAccuracy(
                self.study.sensor.shape,
                self.study.pitch,
                method.model,
                method.float_type,
                method.oversampling,
                "run" if reason is None else "not run",
                reason,
                error,
                predicted,
                seconds,
                compile_seconds,
                calls,
                cost.flops,
                cost.bytes,
            )
        )


def pareto_front(points: list[tuple[float, float]]) -> list[bool]:
    """Mask of the points (seconds, error) that no other matches in speed and accuracy.

    Errors within 5 % of each other count as equal, so that the last digits of a model's error do
    not make its slower precision worth choosing. Of points that are equal in both the first is.
    """
    best, front = float("inf"), [False] * len(points)
    for number in sorted(range(len(points)), key=lambda number: points[number]):
        error = points[number][1]
        front[number] = error < (1 - _GAIN) * best
        best = error if front[number] else best
    return front


def label(model: str, precision: str, oversampling: int | None) -> str:
    """A candidate in words, such as "angular spectrum ×3, float32"."""
    samples = f" ×{oversampling}" if oversampling else ""
    return f"{words(model)}{samples}, {precision}"


def words(model: str) -> str:
    """A model's name as it is read."""
    return model.replace("rayleigh_s", "Rayleigh-S").replace("_", " ")


@dataclass(frozen=True, eq=False)
class Timed:
    """The result of a function of arrays, and the time that it takes, s.

    - `seconds`: median over `calls` calls after one that does not count, each waited for; of a
      call that takes more than a second, that of the first.
    - `compile_seconds`: tracing and compilation, once.
    """

    result: np.ndarray
    seconds: float
    compile_seconds: float
    calls: int


def _measured(given: Conditions, method: PsfMethod) -> Timed:
    def compute(camera, wavelength, object_distance):
        return psf(camera, wavelength=wavelength, object_distance=object_distance, model=method)

    return measure(compute, given.camera, given.wavelength, given.object_distance)


def measure(function: Callable, *arguments: Any) -> Timed:
    """Compile a function of arrays, call it, and take the times."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    result, first = _timed(compiled, arguments)
    taken = [first] if first > _LONG else []
    while len(taken) < _MOST_CALLS and sum(taken) < _SECONDS:
        taken.append(_timed(compiled, arguments)[1])
    return Timed(np.asarray(result), statistics.median(taken), compile_seconds, len(taken))


def _timed(compiled, arguments) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, time.perf_counter() - start
