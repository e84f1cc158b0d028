"""Errors and times of every way of computing the PSF."""

from collections.abc import Callable
from typing import Any

from thincam_jax._core.precision import allow
from thincam_jax.commands.accuracy.cameras import Conditions, conditions_of, psf_of
from thincam_jax.commands.accuracy.norms import relative_error
from thincam_jax.commands.accuracy.pareto import worth_choosing
from thincam_jax.commands.accuracy.sizes import binned
from thincam_jax.commands.accuracy.timing import measure
from thincam_jax.commands.accuracy.ways import Way, all_ways, why_not
from thincam_jax.commands.study.study import Exposure, Study
from thincam_jax.lensless.accuracy.select import predicted_error, probe_of
from thincam_jax.lensless.psf import psf

Progress = Callable[[str], None]


def psf_rows(
    study: Study, exposure: Exposure, size: int, progress: Progress
) -> list[dict[str, Any]]:
    """A row for every way at one size; `worth_choosing` marks the Pareto front of those run.

    Errors are relative, ‖h − h₀‖₂/‖h₀‖₂ over the sensor, against h₀ by separable in float64, the
    exact Fresnel field. Times are of the compiled function: what Python adds to a call of `psf` is
    left out.
    """
    study = binned(study, size)
    whole = study.config.pixel_integration
    given = conditions_of(study, exposure)
    reference = psf_of(study, exposure)
    rows = []
    with allow("float64"):
        exact = given["float64"]
        probe = probe_of(*exact, whole, None)
        grid = exact.camera.sensor.grid
        for way in all_ways(exact.camera, whole):
            progress(f"{size} pixels: {label(way.model, way.precision, way.oversampling)}")
            row = _described(study, way, why_not(way.model, way.cost, exact))
            if row["status"] == "run":
                row["predicted_error"] = predicted_error(
                    probe, exact.camera, grid, way.model, way.precision, way.oversampling
                )
                row |= _measured(given[way.precision], way, whole, reference)
            rows.append(row)
    run = [row for row in rows if row["status"] == "run"]
    flags = worth_choosing([r["true_error"] for r in run], [r["seconds"] for r in run])
    for row, flag in zip(run, flags, strict=True):
        row["worth_choosing"] = flag
    return rows


def way_count(study: Study, exposure: Exposure) -> int:
    """How many rows a size has."""
    with allow("float64"):
        camera = conditions_of(study, exposure)["float64"].camera
        return len(all_ways(camera, study.config.pixel_integration))


def label(model: str, precision: str, oversampling: int | None) -> str:
    """A way in words, such as "angular spectrum ×3, float32"."""
    samples = f" ×{oversampling}" if oversampling else ""
    return f"{words(model)}{samples}, {precision}"


def words(model: str) -> str:
    """A model's name as it is read."""
    return model.replace("rayleigh_s", "Rayleigh-S").replace("_", " ")


def _described(study: Study, way: Way, reason: str | None) -> dict[str, Any]:
    return {
        "shape": list(study.sensor.shape),
        "pitch_mm": study.sensor.pitch,
        "model": way.model,
        "precision": way.precision,
        "oversampling": way.oversampling,
        "status": "run" if reason is None else "not run",
        "reason": reason,
        "true_error": None,
        "predicted_error": None,
        "seconds": None,
        "compile_seconds": None,
        "calls": 0,
        "flops": way.cost.flops,
        "bytes": way.cost.bytes,
        "worth_choosing": False,
    }


def _measured(given: Conditions, way: Way, pixel_integration: bool, reference) -> dict:
    def compute(camera, wavelength, object_distance):
        return psf(
            camera,
            wavelength=wavelength,
            object_distance=object_distance,
            model=way.model,
            pixel_integration=pixel_integration,
            oversampling=way.oversampling,
            mask_shape=way.mask_shape,
            precision=way.precision,
        )

    timing = measure(compute, *given)
    return {
        "true_error": relative_error(timing.result, reference),
        "seconds": timing.seconds,
        "compile_seconds": timing.compile_seconds,
        "calls": timing.calls,
    }
