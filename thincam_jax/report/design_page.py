"""The report of a design: one HTML page that stands alone."""

from pathlib import Path
from typing import Any

from thincam_jax.config import dump_config
from thincam_jax.config_design import DesignConfig
from thincam_jax.report.template import data_url, load_template

_SYMBOLS = {"beta": "β", "distance": "distance"}
_UNITS = {"beta": "rad/mm²", "distance": "mm"}


def render(
    config: DesignConfig, folder: Path, design: dict[str, Any], environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    return load_template("design.html.jinja").render(
        config=config,
        design=design,
        free=[_label(value) for value in design["found"][0]["values"]],
        validated=list(design["validation"]["methods"]),
        findings=findings(design),
        environment=environment,
        yaml=dump_config(config),
        picture=lambda name: data_url(folder / name) if (folder / name).exists() else None,
    )


def _label(value: dict[str, Any]) -> str:
    shots = ", ".join(str(s) for s in value["shots"])
    word = "shot" if len(value["shots"]) == 1 else "shots"
    return f"{_SYMBOLS[value['variable']]} of {word} {shots}, {_UNITS[value['variable']]}"


def findings(design: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences."""
    best, reference = design["found"][0], design["reference"]
    unit = design["objective"]["told"].rpartition("(")[2].rstrip(")")
    sentences = [
        f"The best design by {design['objective']['name']} is {_shots(best)}. The objective "
        f"predicts {best['predicted_gain']:+.3g} {unit} over {reference['name']} "
        f"({_shots(reference)})."
    ]
    sentences += [f"The reference breaks a limit: {why}." for why in reference["broken_limits"]]
    if best["active_limits"]:
        sentences.append(f"It lies against a limit: {'; '.join(best['active_limits'])}.")
    validation = design["validation"]
    for name, targets in validation["methods"].items():
        gains = [
            f"{_spread(t['gain_db'], 2)} dB on {target}"
            for target, t in targets.items()
            if target in validation["pictures"] and t.get("gain_db")
        ]
        if gains:
            sentences.append(f"Simulated, {name} gains {', '.join(gains)}.")
        for target, found in targets.items():
            if target in validation["charts"] and found.get("gain_elements"):
                steps = _spread(found["gain_elements"], 1)
                psnr = (
                    f"{_spread(found['gain_db'], 2)} dB" if found["gain_db"] else "an exact image"
                )
                sentences.append(f"On {target}, {name} resolves {steps} elements more, at {psnr}.")
    if not validation["one_object_grid"]:
        sentences.append(
            "The designs' largest distances differ, and with them the object's pixels (in the "
            "table below): their PSNR is not on one grid and compares to some tenths of a dB only."
        )
    return sentences


def _shots(one: dict[str, Any]) -> str:
    each = (f"β {s['beta_rad_per_mm2']:.4g} at {s['distance_mm']:.4g} mm" for s in one["shots"])
    return " and ".join(each)


def _spread(spread: dict[str, Any], digits: int) -> str:
    text = f"{spread['mean']:+.{digits}f}"
    if spread["deviation"] is not None:
        text += f" ± {spread['deviation']:.{digits}f}"
    return text
