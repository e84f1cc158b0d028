"""The report of a refocus run: one HTML page that stands alone."""

from typing import Any

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.page import data_url, load_template
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.run_folder import RunFolder


def render(
    config: RefocusConfig, folder: RunFolder, metrics: dict[str, Any], environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    return load_template("refocus").render(
        config=config,
        metrics=metrics,
        findings=findings(config, metrics),
        environment=environment,
        yaml=dump_config(config),
        picture=lambda name: data_url(folder.path / "figures" / name),
    )


def findings(config: RefocusConfig, metrics: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences."""
    sentences = []
    for name, found in metrics["objects"].items():
        if found["found_mm"] is None:
            sentences.append(f"{name}, placed at {found['distance_mm']:g} mm, was not found.")
            continue
        sentences.append(
            f"{name}, placed at {found['distance_mm']:g} mm, is sharpest at "
            f"{found['found_mm']:.1f} mm ({found['error_percent']:+.1f} %)."
        )
    spans = [found["axial_resolution_mm"] for found in metrics["objects"].values()]
    distances = sorted(placed.distance for placed in config.objects)
    if len(distances) > 1:
        gap = min(b - a for a, b in zip(distances, distances[1:], strict=False))
        sentences.append(
            f"The objects stand {gap:g} mm apart or more; the depth of focus, "
            f"π t (t+d) / (β d R²), is {min(spans):.0f} to {max(spans):.0f} mm."
        )
    return sentences
