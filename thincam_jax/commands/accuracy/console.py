"""The results in short, on the console."""

from typing import Any

from rich.table import Table

from thincam_jax.commands.accuracy.psfs import label, words
from thincam_jax.commands.terminal import numbers


def accuracy_table(results: dict[str, Any]) -> Table:
    """Every candidate at the largest size, the fastest first; those worth choosing are marked."""
    largest = max((row["shape"] for row in results["psfs"]), key=max)
    rows = [row for row in results["psfs"] if row["shape"] == largest]
    rows.sort(key=lambda row: row["seconds"] or float("inf"))
    told = [["PSF", "error", "predicted", "time ms", "compile s", "worth it"]]
    for row in rows:
        name = label(row["model"], row["precision"], row["oversampling"])
        if row["status"] != "run":
            told.append([name, "not run", *["–"] * 4])
            continue
        error = "reference" if row["true_error"] == 0 else _error(row["true_error"])
        times = f"{1000 * row['seconds']:.2f}", f"{row['compile_seconds']:.1f}"
        worth = "yes" if row["worth_choosing"] else ""
        told.append([name, error, _error(row["predicted_error"]), *times, worth])
    return numbers(told, title=f"{largest[0]}×{largest[1]} pixels", title_justify="left")


def cost_table(results: dict[str, Any]) -> Table:
    """What the errors do to captures and reconstructions."""
    rows, columns = results["settings"]["capture_shape"]
    title = f"{results['settings']['target']} at {rows}×{columns} pixels"
    told = [["assumed", "PSF error", "capture error", "without mean", "PSNR lost dB"]]
    found = results["reconstructions"]
    lost = {row["model"]: row.get("psnr_lost_db") for row in found["models"]}
    for row in results["captures"]:
        if row["status"] != "run":
            told.append([words(row["model"]), "not run", "–", "–", "–"])
            continue
        errors = (row["psf_error"], row["error"], row["contrast_error"])
        loss = _decibels(lost.get(row["model"]))
        told.append([words(row["model"]), *map(_error, errors), loss])
    for row in found["controlled"]:
        if row["status"] == "run":
            name = f"exact, {_NAMES[row['wrong']]} wrong by {row['change']:.1e}"
            errors = (row["psf_error"], row["capture_error"], row["capture_contrast_error"])
            told.append([name, *map(_error, errors), _decibels(row["psnr_lost_db"])])
    return numbers(told, title=title, title_justify="left")


_NAMES = {"beta": "β", "distance": "d"}


def verdict(results: dict[str, Any]) -> list[str]:
    """One sentence on what a PSF error of 1 % costs, and one on what was not reconstructed."""
    found = results["reconstructions"]
    if found["skipped"]:
        return [f"no reconstruction: {found['skipped']}"]
    costs = [
        f"{_decibels(row['psnr_lost_db'])} dB by a wrong {_NAMES[row['wrong']]}"
        for row in found["controlled"]
        if row["level"] == 0.01 and row["status"] == "run"
    ]
    text = " and ".join(costs) if costs else "cannot be told"
    return [f"a PSF error of 1 % costs {found['method']} {text}"]


def _error(value: float) -> str:
    return f"{value:.1e}"


def _decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}".replace("-", "−")
