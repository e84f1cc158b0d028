"""The report: one HTML page that stands alone."""

from typing import Any

from thincam_jax.commands.config_file import slug
from thincam_jax.commands.page import render_page
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.config import StudyConfig

# What two methods share that add and subtract the same captures in the same way.
_CAPTURES = ("shots", "synthesis", "phases", "steps", "harmonics")


def render(
    config: StudyConfig, folder: RunFolder, metrics: dict[str, Any], environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    shown = {
        "command": "run",
        "environment": environment,
        "methods": metrics["methods"],
        "warnings": metrics["warnings"],
        "findings": findings(config, metrics),
        "slug": slug,
    }
    return render_page("study", config, folder.path / "figures", shown)


def findings(config: StudyConfig, metrics: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences, beside what was published."""
    sentences = []
    for name, method in metrics["methods"].items():
        published = method["published"]
        mean, stated = method["mean_psnr_of_pictures_db"], published["psnr_db"]
        if mean is not None and stated is not None:
            sentences.append(
                f"{name}: {mean:.1f} dB on average over the pictures, published {stated:.1f} dB "
                f"({mean - stated:+.1f} dB)."
            )
        resolved, stated = _resolved(method), published["resolved_object_mm"]
        if resolved is not None and stated is not None:
            word = "finer" if resolved < 0.97 * stated else "coarser"
            word = "the same within 3 %" if abs(resolved / stated - 1) <= 0.03 else word
            sentences.append(
                f"{name}: resolves a line pair of {resolved:.2f} mm on the object, published "
                f"{stated:.2f} mm: {word}."
            )
    sentences += _gains(config, metrics)
    ranked = sorted(
        (r, name) for name, m in metrics["methods"].items() if (r := _resolved(m)) is not None
    )
    if len(ranked) > 1:
        order = ", ".join(f"{name} ({period:.2f} mm)" for period, name in ranked)
        sentences.append(f"From finest to coarsest on the chart: {order}.")
    return sentences


def _resolved(method: dict[str, Any]) -> float | None:
    for target in method["targets"].values():
        if target["resolved"] is not None:
            return target["resolved"]["object_mm"]
    return None


def _gains(config: StudyConfig, metrics: dict[str, Any]) -> list[str]:
    """What total variation adds to the Wiener synthesis of the same captures."""
    sentences = []
    for method in (m for m in config.methods if m.kind == "admm_tv"):
        for other in (m for m in config.methods if m.kind == "wiener"):
            if any(getattr(other, key) != getattr(method, key) for key in _CAPTURES):
                continue
            pairs = (
                (t.name, *(metrics["methods"][m.name]["targets"][t.name]["psnr_db"] for m in pair))
                for t in config.targets
                for pair in [(method, other)]
            )
            gains = [f"{a - b:+.1f} dB on {t}" for t, a, b in pairs if None not in (a, b)]
            if gains:
                sentences.append(f"{method.name}: {', '.join(gains)} over {other.name}.")
    return sentences
