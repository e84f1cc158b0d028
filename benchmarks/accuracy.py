"""Error and time of every PSF model of a study's camera, and what errors cost its images.

    python benchmarks/accuracy.py configs/quick.yaml [SIZE ...]

writes runs/NAME-accuracy/accuracy.json, which draw_accuracy.py draws. The camera is that of the
first exposure. Captured is the first picture, and reconstructed by the first Wiener method.

Errors are relative, ‖h − h₀‖₂/‖h₀‖₂ over the sensor, against h₀ by separable in float64, the exact
Fresnel field. SIZE: pixels along the sensor's longer side, to which it is binned for the PSFs.
"""

import json
import math
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from thincam_jax._core.environment import usable_cores
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import available_bytes, readable
from thincam_jax._core.precision import PRECISIONS, allow, cast
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.kinds import load_study
from thincam_jax.commands.study.build import build_study
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.accuracy.select import predicted_error, probe_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.forward import imaging_operator, project, projected_shape
from thincam_jax.lensless.method import SAMPLED, PsfMethod, models_of, psf_method
from thincam_jax.lensless.propagation.closed_form import in_focus
from thincam_jax.lensless.psf import psf
from thincam_jax.lensless.resolve import psf_cost
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import evaluate, field_shape, reconstructor, stacked, take
from thincam_jax.studies.study import Method, Study, Target

SIZES, CAPTURE_SIZE = (128, 256, 512), 256  # and the sensor's own, where it is smaller
OVERSAMPLINGS = (1, 3)
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF, by a wrong β or a wrong d
DIRECT_SUM_LIMIT = 2e10  # operations of a direct sum that take some seconds; not run beyond
# A median of at most so many calls, and no further one once they took so many seconds.
MOST_CALLS, SECONDS = 15, 0.5
GAIN = 0.05  # a smaller error by less than this part is no gain
# Relative changes come in these steps: distances of few digits then keep their ratio to the last
# bit in float32, and no reconstruction is compiled anew.
STEP = 2.0**-20


class Conditions(eqx.Module):
    """Camera, wavelength (mm) and object distance (mm) in one precision."""

    camera: LenslessCamera
    wavelength: jax.Array
    object_distance: jax.Array


class Case(NamedTuple):
    """A target before a study's camera with binned pixels; the first exposure is captured."""

    study: Study
    method: Method
    target: Target


def binned(study: Study, size: int) -> Study:
    """The study with `size` pixels along the sensor's longer side; the sensor keeps its area."""
    ratio = max(study.sensor.shape) / size
    rows, columns = (max(1, round(n / ratio)) for n in study.sensor.shape)
    return replace(
        study, sensor=replace(study.sensor, shape=(rows, columns), pitch=study.pitch * ratio)
    )


def conditions_of(study, exposure) -> dict[str, Conditions]:
    """One exposure in each precision, from the numbers of float32.

    So a difference between the two is what the arithmetic leaves, not how the numbers are stored.
    """
    with allow("float64"):
        numbers = (exposure.wavelength, study.object_distance)
        wavelength, distance = (jnp.asarray(np.float32(n)) for n in numbers)
        single = cast(study.camera(exposure), "float32")
        return {p: Conditions(*cast((single, wavelength, distance), p)) for p in PRECISIONS}


def psf_of(study, exposure, model="separable", precision="float64", shape=None) -> np.ndarray:
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


def relative_error(image, reference) -> float:
    """‖image − reference‖₂ / ‖reference‖₂."""
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def contrast_error(image, reference) -> float:
    """Relative error without each (y, x) image's mean: a capture's bias carries no picture."""
    return relative_error(*(c - c.mean(axis=(-2, -1), keepdims=True) for c in (image, reference)))


def why_not(model, cost, given: Conditions) -> str | None:
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


def timed(given: Conditions, method) -> tuple[np.ndarray, dict[str, Any]]:
    """A PSF, the median time of a compiled call and the time of compilation, s."""

    def compute(camera, wavelength, distance):
        return psf(camera, wavelength=wavelength, object_distance=distance, model=method)

    def call():
        start = time.perf_counter()
        result = jax.block_until_ready(compiled(*arguments))
        return result, time.perf_counter() - start

    arguments = given.camera, given.wavelength, given.object_distance
    start = time.perf_counter()
    compiled = jax.jit(compute).lower(*arguments).compile()
    compiling = time.perf_counter() - start
    h, first = call()
    taken = [first] if first > 1 else []  # so long a call needs no warming up
    while len(taken) < MOST_CALLS and sum(taken) < SECONDS:
        taken.append(call()[1])
    times = {"seconds": statistics.median(taken), "compile_seconds": compiling}
    return np.asarray(h), times | {"calls": len(taken)}


def psf_errors(study: Study, size: int) -> list[dict[str, Any]]:
    """Every model in both precisions, the sampled ones at each oversampling."""
    study, exposure, rows = binned(study, size), study.exposures[0], []
    given = conditions_of(study, exposure)
    with allow("float64"):
        exact = given["float64"]
        mask, grid = exact.camera.mask, exact.camera.sensor.grid
        numbers = exact.camera, exact.wavelength, exact.object_distance
        probe = probe_of(*numbers, study.pixel_integration)
        reference = psf_of(study, exposure)
        for model in models_of(mask):
            for oversampling in OVERSAMPLINGS if model in SAMPLED else (None,):
                for precision in PRECISIONS:
                    print(f"{size} pixels: {words(model)}, {precision}", flush=True)
                    asked = PsfMethod(
                        model, precision, study.pixel_integration, oversampling=oversampling
                    )
                    method = psf_method(mask, grid, asked)
                    cost = psf_cost(mask, grid, method)
                    row: dict[str, Any] = {
                        "shape": list(study.sensor.shape),
                        "pitch_mm": study.pitch,
                        **{"model": model, "precision": precision, "oversampling": oversampling},
                        **{"flops": cost.flops, "bytes": cost.bytes},
                    }
                    row |= ran(why_not(model, cost, exact))
                    if row["status"] == "run":
                        h, times = timed(given[precision], method)
                        row["predicted_error"] = predicted_error(probe, mask, grid, method)
                        row |= {"true_error": relative_error(h, reference), **times}
                    rows.append(row)
    measured = [row for row in rows if row.get("true_error")]  # the reference has no error
    best = math.inf
    for row in sorted(measured, key=lambda row: (row["seconds"], row["true_error"])):
        # Nothing measured is both faster and more accurate; within 5 % errors count as equal.
        row["worth_choosing"] = row["true_error"] < (1 - GAIN) * best
        best = row["true_error"] if row["worth_choosing"] else best
    return [{"worth_choosing": False} | row for row in rows]


def ran(reason: str | None) -> dict[str, Any]:
    return {"status": "run" if reason is None else "not run", "reason": reason}


def kernel_reason(case: Case, exposure, model) -> str | None:
    """Why a model is not run for a capture; None where it is."""
    with allow("float64"):
        given = conditions_of(case.study, exposure)["float64"]
        single = PsfMethod(model, "float32", case.study.pixel_integration)
        grid = Grid(reach(case), jnp.asarray(given.camera.sensor.pitch))
        method = psf_method(given.camera.mask, grid, single)
        return why_not(model, psf_cost(given.camera.mask, grid, method), given)


def reach(case: Case) -> tuple[int, int]:
    """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
    camera = case.study.camera(case.method.exposures[0])
    return kernel_shape(camera.sensor.shape, projected_shape(camera, case.target.plane))


def clean_capture(case: Case, model="separable", precision="float64", assumed=None) -> np.ndarray:
    """Light on the sensor, (channel, y, x), without noise or saturation.

    With `assumed`, the PSF is that of another exposure; where the scene falls stays as it is.
    """
    exposure = case.method.exposures[0]
    with allow(precision):
        camera = conditions_of(case.study, exposure)[precision].camera
        blurring = conditions_of(case.study, assumed or exposure)[precision]
        plane = cast(case.target.plane, precision)
        shape = projected_shape(camera, plane)
        convolution = imaging_operator(
            blurring.camera,
            cast(Spectrum(blurring.wavelength), precision),
            blurring.object_distance,
            field_shape=shape,
            model=model,
            pixel_integration=case.study.pixel_integration,
        )
        return np.asarray(convolution(project(camera, plane, shape)))


def capture_errors(case: Case) -> list[dict[str, Any]]:
    """Errors of noise-free captures in float32 by each model.

    `kernel_error` counts all that the capture takes of the PSF, which reaches beyond the sensor.
    """
    exposure, rows, shapes = case.method.exposures[0], [], (None, reach(case))
    reference = clean_capture(case)
    exact = [psf_of(case.study, exposure, shape=shape) for shape in shapes]
    for model in models_of(case.study.mask):
        print(f"capture: {words(model)}", flush=True)
        row = {"model": model} | ran(kernel_reason(case, exposure, model))
        if row["status"] == "run":
            image = clean_capture(case, model, "float32").astype(float)
            psfs = [psf_of(case.study, exposure, model, "float32", shape) for shape in shapes]
            of_psf, of_kernel = map(relative_error, psfs, exact)
            row |= {"psf_error": of_psf, "kernel_error": of_kernel}
            row["error"] = relative_error(image, reference)
            row["contrast_error"] = contrast_error(image, reference)
        rows.append(row)
    return rows


def changed(method: Method, quantity: str, part: float) -> Method:
    """The method with one quantity of all its exposures multiplied by 1 + part."""
    other = {quantity: getattr(method.exposures, quantity) * (1 + part)}
    return replace(method, exposures=replace(method.exposures, **other))


def psfs_of(study: Study, method: Method) -> np.ndarray:
    """The exact PSFs (exposure, y, x) of a method on the sensor, in float64."""
    return np.stack([psf_of(study, exposure) for exposure in method.exposures])


def solve(case: Case, quantity: str, level: float, reference: np.ndarray) -> float | None:
    """The relative change of a quantity that makes the method's PSFs wrong by `level`, to 1 %.

    None where no change of up to a half does it.
    """

    def excess(logarithm: float) -> float:
        wrong = psfs_of(case.study, changed(case.method, quantity, math.exp(logarithm)))
        # A change may be too small to be seen.
        return math.log(max(relative_error(wrong, reference), sys.float_info.min) / level)

    first, end = math.log(1e-5), math.log(0.5)
    guess = min(first - excess(first), end)  # small errors grow in proportion to what is wrong
    for around in (0.3, 1.0, 3.0, 10.0):
        low, high = guess - around, min(guess + around, end)
        if excess(low) < 0 < excess(high):
            found = scipy.optimize.root_scalar(
                excess, bracket=(low, high), method="brentq", xtol=0.005, rtol=1e-9
            )
            return max(1, round(math.exp(found.root) / STEP)) * STEP
    return None


def reconstruction_costs(case: Case) -> dict[str, Any]:
    """PSNR with the exact PSFs, and what is lost of it by each model and by a wrong β or d.

    Of a wrong camera the worse of a change up and down counts; the scale of the object is the true
    one, so that only the PSF is wrong.
    """
    study, method, target = case
    found: dict[str, Any] = {"method": method.name, "skipped": None, "exact_psnr_db": None}
    found |= {"models": [], "controlled": []}
    if method.solver.name != "wiener":
        return found | {"skipped": f"{method.name}: fringe scanning assumes no PSF"}
    captures = stacked([take(study, exposure, target) for exposure in method.exposures])
    exact, clean, pitch = psfs_of(study, method), clean_capture(case), None

    def reached(assumed: Method, model="separable") -> dict[str, float]:
        nonlocal pitch  # the same pixels of the object whatever camera is assumed
        shape = field_shape(study, method, target)
        solved = reconstructor(replace(study, model=model), assumed, shape, target.distance)
        image = solved(*captures)
        pitch = image.pitch if pitch is None else pitch
        judged = evaluate(method, target, Reconstruction(image.image, pitch))
        reached = psnr(judged.image, judged.truth)
        if found["exact_psnr_db"] is None:
            found["exact_psnr_db"] = reached
        return {"psnr_db": reached, "psnr_lost_db": found["exact_psnr_db"] - reached}

    reached(method)
    for model in models_of(study.mask):
        print(f"reconstruction: {words(model)}", flush=True)
        reasons = [kernel_reason(case, exposure, model) for exposure in method.exposures]
        row = {"model": model} | ran(next((r for r in reasons if r), None))
        if row["status"] == "run":
            psfs = [psf_of(study, exposure, model, "float32") for exposure in method.exposures]
            row |= {"psf_error": relative_error(np.stack(psfs), exact), **reached(method, model)}
        found["models"].append(row)
    for quantity in ("beta", "distance"):
        for level in LEVELS:
            print(f"a PSF error of {100 * level:g} % by a wrong {quantity}", flush=True)
            part = solve(case, quantity, level, exact)
            reason = None if part else f"no change of {quantity} of up to a half gives this error"
            row = {"wrong": quantity, "level": level} | ran(reason)
            if part is not None:
                up, down = (changed(method, quantity, p) for p in (part, -part))
                wrong = clean_capture(case, assumed=up.exposures[0])
                row |= {"change": part, "psf_error": relative_error(psfs_of(study, up), exact)}
                row["capture_error"] = relative_error(wrong, clean)
                row["capture_contrast_error"] = contrast_error(wrong, clean)
                row |= max((reached(m) for m in (up, down)), key=lambda r: r["psnr_lost_db"])
            found["controlled"].append(row)
    return found


def words(model: str) -> str:
    """A model's name as it is read."""
    return model.replace("rayleigh_s", "Rayleigh-S").replace("_", " ")


def numbers(exposure) -> dict[str, float]:
    values = exposure.beta, exposure.phase, exposure.distance, exposure.wavelength
    names = "beta_rad_per_mm2", "phase_rad", "distance_mm", "wavelength_mm"
    return dict(zip(names, values, strict=True))


def main(path: str, *sizes: str) -> None:
    config = load_study(path, (), "the benchmark takes a study")
    study = build_study(config)
    own = max(study.sensor.shape)
    taken = sorted({int(size) for size in sizes} or {*(s for s in SIZES if s < own), own})
    coarse = replace(binned(study, min(CAPTURE_SIZE, own)), model="separable")
    pictures = [target for target in coarse.targets if target.is_picture]
    wiener = [method for method in coarse.methods if method.solver.name == "wiener"]
    case = Case(coarse, [*wiener, *coarse.methods][0], [*pictures, *coarse.targets][0])
    results = {
        "bench": "accuracy",
        "config": dump_config(config),
        "machine": {
            "device_kind": jax.devices()[0].device_kind,
            "cores": usable_cores(),
            "jax": jax.__version__,
        },
        "settings": {
            "study": study.name,
            "reference": "separable, float64",
            "sizes": taken,
            "camera": numbers(study.exposures[0]),
            "object_distance_mm": study.object_distance,
            "pixel_integration": study.pixel_integration,
            "capture_shape": list(coarse.sensor.shape),
            "target": case.target.name,
            "captured": numbers(case.method.exposures[0]),
        },
        "psfs": [row for size in taken for row in psf_errors(study, size)],
        "captures": capture_errors(case),
        "reconstructions": reconstruction_costs(case),
    }
    out = Path("runs") / f"{study.name}-accuracy" / "accuracy.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(results, indent=1) + "\n", "utf-8")
    print(out)


if __name__ == "__main__":
    main(*sys.argv[1:])
