"""The results in short, on the console."""

from typing import Any

from rich.table import Table

from thincam_jax.commands.accuracy.psfs import label, words


def accuracy_table(results: dict[str, Any]) -> Table:
    """Every candidate at the largest size, the fastest first; those worth choosing are marked."""
    largest = max((row["shape"] for row in results["psfs"]), key=max)
    rows = [row for row in results["psfs"] if row["shape"] == largest]
    rows.sort(key=lambda row: row["seconds"] or float("inf"))
    table = Table("PSF", title=f"{largest[0]}×{largest[1]} pixels", title_justify="left")
    for heading in ("error", "predicted", "time ms", "compile s", "worth it"):
        table.add_column(heading, justify="right")
    for row in rows:
        name = label(row["model"], row["precision"], row["oversampling"])
        if row["status"] != "run":
            table.add_row(name, "not run", *["–"] * 4)
            continue
        table.add_row(
            name,
            "reference" if row["true_error"] == 0 else f"{row['true_error']:.1e}",
            f"{row['predicted_error']:.1e}",
            f"{1000 * row['seconds']:.2f}",
            f"{row['compile_seconds']:.1f}",
            "yes" if row["worth_choosing"] else "",
        )
    return table


def cost_table(results: dict[str, Any]) -> Table:
    """What the errors do to captures and reconstructions."""
    rows, columns = results["settings"]["capture_shape"]
    title = f"{results['settings']['target']} at {rows}×{columns} pixels"
    table = Table("assumed", title=title, title_justify="left")
    for heading in ("PSF error", "capture error", "without mean", "PSNR lost dB"):
        table.add_column(heading, justify="right")
    found = results["reconstructions"]
    lost = {row["model"]: row.get("psnr_lost_db") for row in found["models"]}
    for row in results["captures"]:
        if row["status"] != "run":
            table.add_row(words(row["model"]), "not run", "–", "–", "–")
            continue
        errors = (row["psf_error"], row["error"], row["contrast_error"])
        table.add_row(words(row["model"]), *map(_error, errors), _decibels(lost.get(row["model"])))
    for row in found["controlled"]:
        if row["status"] == "run":
            name = f"exact, {_NAMES[row['wrong']]} wrong by {row['change']:.1e}"
            errors = (row["psf_error"], row["capture_error"], row["capture_contrast_error"])
            table.add_row(name, *map(_error, errors), _decibels(row["psnr_lost_db"]))
    return table


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
