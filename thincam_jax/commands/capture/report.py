"""The report of captures: what was shown and taken, and what was reconstructed from it."""

from typing import Any

from thincam_jax._core.table import Table
from thincam_jax.commands.capture.config import CaptureConfig
from thincam_jax.commands.report import Page, Part, Picture

_MATRIX = (
    "The matrix is in matrix.zarr; a capture of another picture, less the dark frame, is "
    "reconstructed with it by "
    '`tc.reconstruct(tc.Recording(capture, read_matrix("matrix.zarr")), tc.AdmmTV())`, '
    "read_matrix from thincam_jax.measured.calibration. For many captures, its reduced form is in "
    "reduced.npz, read by `ReducedMatrix.load`."
)


def page(config: CaptureConfig, metrics: dict[str, Any]) -> Page:
    """The page of a finished run."""
    agreement = metrics.get("agreement", {})
    beside = ", beside that of a direct simulation with other noise, and without"
    seen = "What the sensor sees of single cells (row, column)"
    seen += ": measured, and by direct simulation. " if agreement else ". "
    devices = [f"display {config.display.driver}"]
    devices += [f"stage {config.stage.driver}"] if config.stage else []
    lead = (
        f"Plan {config.plan.kind.replace('_', ' ')} on a {config.rig} rig: camera "
        f"{config.camera.driver}, exposure {1000 * config.camera.exposure:g} ms; "
        f"{'; '.join(devices)}.",
        Picture(
            "images.png",
            "Reconstructions",
            f"The image reconstructed{beside if agreement else ''}.",
        ),
        Picture("columns.png", "Columns of the system matrix", seen + _MATRIX),
        Picture("shown.png", "Patterns shown", "What the display showed."),
        Picture("frames.png", "Frames taken", "What the camera took, without the dark frame."),
    )
    rows = [(name.replace("_", " "), _numbers(value)) for name, value in agreement.items()]
    time = Picture("seconds.png", "Time of the steps", "Time of all frames, by step.")
    explained = (
        "Differences over the standard deviation that the noise has: 1 is agreement within the "
        "noise."
    )
    compared = Part("Beside direct simulation", (Table(("number", "found"), rows), explained))
    parts = [compared] if rows else []
    parts += [Part("Time", (time,))] if metrics["seconds"] else []
    parts += [Part("Notes", config.notes)] if config.notes else []
    return Page(lead, parts)


def _numbers(value: Any) -> str:
    return ", ".join(str(v) for v in value) if isinstance(value, list) else str(value)
