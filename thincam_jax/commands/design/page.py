"""Page of a design: its tables and sentences, made of design.json."""

from collections.abc import Sequence
from typing import Any

from thincam_jax.commands.design.record import COSTS, SHOT_KEYS
from thincam_jax.commands.page import number
from thincam_jax.design import FreeValue
from thincam_jax.design.objectives import OBJECTIVES
from thincam_jax.design.space import REPORTED

_ALWAYS = ("beta", "distance")


def shown(design: dict[str, Any]) -> dict[str, Any]:
    """What the page takes beside the record, made of it."""
    free = [(value["variable"], value["shots"]) for value in design["found"][0]["values"]]
    return {
        "free": [REPORTED[name].of_shots(shots) for name, shots in free],
        "reference": [of_shots(design["reference"], *one) for one in free],
        "numbers": [[found_number(v) for v in one["values"]] for one in design["found"]],
        "unit": objective_unit(design),
        "findings": findings(design),
        "fronts": fronts(design),
    }


def objective_unit(design: dict[str, Any]) -> str:
    """Unit of the objective."""
    return OBJECTIVES[design["objective"]["name"]].unit


def findings(design: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences."""
    best, reference = design["found"][0], design["reference"]
    names = reported_names([best, reference])
    by = "training" if design["training"] else design["objective"]["name"]
    sentences = [
        f"The best design by {by} is {' and '.join(in_words(best, names))}. The objective "
        f"predicts {best['predicted_gain']:+.3g} {objective_unit(design)} over {reference['name']} "
        f"({' and '.join(in_words(reference, names))})."
    ]
    if best["training_gain_db"] is not None:
        sentences.append(f"On the training images it gains {best['training_gain_db']:+.2f} dB.")
    sentences += [f"The reference breaks a limit: {why}." for why in reference["broken_limits"]]
    if best["active_limits"]:
        sentences.append(f"It lies against a limit: {'; '.join(best['active_limits'])}.")
    validation = design["validation"]
    for name, targets in validation["methods"].items():
        gains = [
            f"{_worth(t['gain_db'])} on {target}"
            for target, t in targets.items()
            if target in validation["pictures"] and t.get("gain_db")
        ]
        if gains:
            sentences.append(f"Simulated, {name} gains {', '.join(gains)}.")
        for target, found in targets.items():
            if target in validation["charts"] and found.get("gain_elements"):
                steps = _spread(found["gain_elements"], 1)
                psnr = _worth(found["gain_db"]) if found["gain_db"] else "an exact image"
                sentences.append(f"On {target}, {name} resolves {steps} elements more, at {psnr}.")
    if not validation["one_object_grid"]:
        sentences.append(
            "The designs' largest distances differ, and with them the object's pixels (in the "
            "table below): their PSNR is not on one grid and compares to some tenths of a dB only."
        )
    return sentences


_LIMIT = (
    "Resolution is the frequency up to which every ring of frequencies has a signal-to-noise "
    "ratio of at least 1."
)


def fronts(design: dict[str, Any]) -> list[dict[str, Any]]:
    """Of each Pareto front its table: title, labels of the columns, rows of texts, a sentence."""
    known, reference = design.get("pareto", {}), design["reference"]["name"]
    return [_front(name, known[name], reference) for name in COSTS if name in known]


def _front(name: str, front: dict[str, Any], reference: str) -> dict[str, Any]:
    label, cost = COSTS[name]
    names = reported_names([*front["points"], front["reference"]])
    labels = [REPORTED[name].label for name in names]
    points = [(_cost(p[cost]), p) for p in front["points"]]
    points.append((f"{reference}: {_cost(front['reference'][cost])}", front["reference"]))
    kept = {True: "no", False: "yes", None: ""}
    if name == "captures":
        pictures = list(front["points"][0]["simulated_psnr_db"])
        return {
            "title": "Captures against PSNR",
            "labels": [
                label,
                *labels,
                "predicted, dB",
                *(f"{p}, dB" for p in pictures),
                "front",
            ],
            "rows": [
                [
                    *(text, *cells(p, names), f"{p['predicted_psnr_db']:.2f}"),
                    *(number(p.get("simulated_psnr_db", {}).get(n), 2) for n in pictures),
                    kept[p.get("dominated")],
                ]
                for text, p in points
            ],
            "note": f"The exposure is {front['exposure']}. Predicted from the error of the best "
            "linear reconstruction and the mean variance of the pictures; simulated in full at one "
            "seed. The front is that of the prediction. Where distances differ, so do the object's "
            "pixels, and simulated PSNR compares to some tenths of a dB only.",
        }
    return {
        "title": f"{name.capitalize()} against resolution",
        "labels": [label, *labels, "cycles/rad", "line pairs/mm on the object", "", "front"],
        "rows": [
            [
                *(text, *cells(p, names)),
                f"{p['resolution_cycles_per_rad']:.1f}",
                f"{p['resolution_line_pairs_per_mm']:.3f}",
                p["resolution_ends"] or "",
                kept[p.get("dominated")],
            ]
            for text, p in points
        ],
        "note": _LIMIT,
    }


def _cost(value: float | int) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"


def _worth(gain: dict[str, Any]) -> str:
    """A gain of PSNR, and what it does to the error: "−1.06 dB (28 % more squared error)"."""
    change = 100 * (10 ** (-gain["mean"] / 10) - 1)
    word = "more" if change > 0 else "less"
    return f"{_spread(gain, 2)} dB ({abs(change):.0f} % {word} squared error)"


def _spread(spread: dict[str, Any], digits: int) -> str:
    text = f"{spread['mean']:+.{digits}f}"
    if spread["deviation"] is not None:
        text += f" ± {spread['deviation']:.{digits}f}"
    return text


def of_shots(one: dict[str, Any], name: str, shots: Sequence[int]) -> str:
    """A number of a design of design.json, of the first of these shots; of all, where none is."""
    first = one["shots"][shots[0] - 1 if shots else 0]
    return f"{first[SHOT_KEYS[name]]:{REPORTED[name].form}}"


def found_number(value: dict[str, Any]) -> str:
    """A free number of design.json, with its tolerance."""
    return str(FreeValue(value["variable"], (), value["value"], value["tolerance"]))


def reported_names(designs: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """β and distance, and what else is not the same in all shots of all designs."""
    every = [shot for one in designs for shot in one["shots"]]
    return tuple(
        name
        for name, key in SHOT_KEYS.items()
        if name in _ALWAYS or len({shot.get(key) for shot in every}) > 1
    )


def cells(one: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Each number of all shots; one that all share stands once, but for β."""
    row = []
    for name in names:
        texts = [of_shots(one, name, [shot]) for shot in range(1, len(one["shots"]) + 1)]
        row.append(", ".join(texts if len(set(texts)) > 1 or name == "beta" else texts[:1]))
    return row


def in_words(one: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Each shot of a design: "β 25.00 at 5.00 mm", "β 21.00 at 6.50 mm"."""
    each = []
    for shot in range(1, len(one["shots"]) + 1):
        words = f"β {of_shots(one, 'beta', [shot])} at {of_shots(one, 'distance', [shot])} mm"
        for name in names:
            if name not in _ALWAYS:
                number = REPORTED[name]
                words += f", {number.name} {of_shots(one, name, [shot])} {number.unit}".rstrip()
        each.append(words)
    return each
