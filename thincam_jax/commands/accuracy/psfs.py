"""Errors and times of every candidate: model, precision and oversampling of the PSF."""

import statistics
import time
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np

from thincam_jax._core.memory import available_bytes, readable
from thincam_jax._core.precision import PRECISIONS, allow
from thincam_jax.commands.accuracy.cameras import (
    Conditions,
    binned,
    conditions_of,
    psf_of,
    relative_error,
)
from thincam_jax.commands.run_folder import Step
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.lensless.accuracy.select import predicted_error, probe_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import Cost, psf_cost
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.method import MODELS, SAMPLED, Model, PsfMethod, psf_method
from thincam_jax.lensless.propagation.closed_form import in_focus
from thincam_jax.lensless.psf import psf

OVERSAMPLINGS = (1, 3)
# Operations of a direct sum that take some seconds; it is not run beyond.
DIRECT_SUM_LIMIT = 2e10
# A median of at most so many calls, and no further one once they took so many seconds.
_MOST_CALLS, _SECONDS = 15, 0.5
# A call that takes longer than this needs no warming up: it is itself the measurement.
_LONG = 1.0
_GAIN = 0.05  # a smaller error by less than this part is no gain


def candidates(camera: LenslessCamera, pixel_integration: bool) -> list[tuple[PsfMethod, Cost]]:
    """Every model in both precisions, the sampled ones at each oversampling."""
    mask, grid = camera.mask, camera.sensor.grid
    methods = [
        psf_method(mask, grid, model, pixel_integration, precision, oversampling)
        for model in MODELS
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


class PsfErrors:
    """A row for every candidate at one size; `worth_choosing` marks the Pareto front.

    It is of those whose error is measured: not of the reference, which has none to compare.

    Errors are relative, ‖h − h₀‖₂/‖h₀‖₂ over the sensor, against h₀ by separable in float64, the
    exact Fresnel field. Times are of the compiled function: what Python adds to a call of `psf` is
    left out. `work` fills `rows`.
    """

    def __init__(self, study: FileStudy, exposure: Exposure, size: int):
        self.study, self.exposure, self.rows = binned(study, size), exposure, []
        self.given = conditions_of(self.study, exposure)
        with allow("float64"):
            found = candidates(self.given["float64"].camera, study.pixel_integration)
        self.work = [
            Step(
                f"{size} pixels: {label(method.model, method.precision, method.oversampling)}",
                partial(self._add, method, cost),
            )
            for method, cost in found
        ]

    @cached_property
    def _exact(self) -> tuple[Any, np.ndarray]:
        """Where errors are predicted from, and the PSF that they count from."""
        given = self.given["float64"]
        numbers = given.camera, given.wavelength, given.object_distance
        probe = probe_of(*numbers, self.study.pixel_integration, None)
        return probe, psf_of(self.study, self.exposure)

    def _add(self, method: PsfMethod, cost: Cost) -> None:
        with allow("float64"):
            exact = self.given["float64"]
            row = _described(self.study, method, cost, why_not(method.model, cost, exact))
            if row["status"] == "run":
                probe, reference = self._exact
                row["predicted_error"] = predicted_error(
                    probe, exact.camera.mask, exact.camera.sensor.grid, method
                )
                row |= _measured(self.given[method.precision], method, reference)
        self.rows.append(row)
        if len(self.rows) == len(self.work):
            mark_front([row for row in self.rows if row["status"] == "run" and row["true_error"]])


def mark_front(rows: list[dict[str, Any]]) -> None:
    """Set `worth_choosing` where no other row is as fast and as accurate: the Pareto front.

    Errors within 5 % of each other count as equal, so that the last digits of a model's error do
    not make its slower precision worth choosing. Of rows that are equal in both the first is.
    """
    best = float("inf")
    for row in sorted(rows, key=lambda row: (row["seconds"], row["true_error"])):
        row["worth_choosing"] = row["true_error"] < (1 - _GAIN) * best
        best = row["true_error"] if row["worth_choosing"] else best


def label(model: str, precision: str, oversampling: int | None) -> str:
    """A candidate in words, such as "angular spectrum ×3, float32"."""
    samples = f" ×{oversampling}" if oversampling else ""
    return f"{words(model)}{samples}, {precision}"


def words(model: str) -> str:
    """A model's name as it is read."""
    return model.replace("rayleigh_s", "Rayleigh-S").replace("_", " ")


def _described(
    study: FileStudy, method: PsfMethod, cost: Cost, reason: str | None
) -> dict[str, Any]:
    return {
        "shape": list(study.sensor.shape),
        "pitch_mm": study.pitch,
        "model": method.model,
        "precision": method.precision,
        "oversampling": method.oversampling,
        "status": "run" if reason is None else "not run",
        "reason": reason,
        "true_error": None,
        "predicted_error": None,
        "seconds": None,
        "compile_seconds": None,
        "calls": 0,
        "flops": cost.flops,
        "bytes": cost.bytes,
        "worth_choosing": False,
    }


def _measured(given: Conditions, method: PsfMethod, reference: np.ndarray) -> dict[str, Any]:
    def compute(camera, wavelength, object_distance):
        return psf(
            camera,
            wavelength=wavelength,
            object_distance=object_distance,
            **method.arguments,
        )

    result, told = measure(compute, given.camera, given.wavelength, given.object_distance)
    return {"true_error": relative_error(result, reference), **told}


def measure(function: Callable, *arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """What a function of arrays gives, and how long it takes.

    - `seconds`: median over `calls` calls after one that does not count, each waited for; of a
      call that takes more than a second, that of the first.
    - `compile_seconds`: tracing and compilation, once, s.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    result, first = _timed(compiled, arguments)
    taken = [first] if first > _LONG else []
    while len(taken) < _MOST_CALLS and sum(taken) < _SECONDS:
        taken.append(_timed(compiled, arguments)[1])
    seconds = {"seconds": statistics.median(taken), "compile_seconds": compile_seconds}
    return np.asarray(result), {**seconds, "calls": len(taken)}


def _timed(compiled, arguments) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, time.perf_counter() - start
