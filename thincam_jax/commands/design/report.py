"""The report of a design: designs found, their simulation, fronts."""

from collections.abc import Sequence

from thincam_jax._core.table import Table, number
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.report import Content, Page, Part, Picture, Sentences, pixels_of
from thincam_jax.design.space import REPORTED
from thincam_jax.studies.design_scores import (
    Candidate,
    DesignScores,
    FrontScores,
    PointScores,
    Validation,
    reported_names,
    signed,
)
from thincam_jax.studies.trials import Spread

_LANDSCAPE = (
    "The objective over free numbers, any others as in the best design, in the approximation that "
    "is searched with; in the legend its exact values. Plain grey lies outside of the bounds or "
    "limits."
)
_TRAINING = "The error of the training images over free numbers, any others as in the best design."
_RESPONSES = "What the captures say of each frequency of the scene: η_f J, averaged over rings."
_TRANSFER = (
    "Modulation transfer of {} (left) and of the best design (right). Thick: camera and best "
    "linear reconstruction, η_f J / (1 + η_f J), the part of a scene's contrast that the picture "
    "shows at this noise, mean over rings. Thin: each sum of captures, |Σ W_k H_k| over the light "
    "Σ |W_k| H_k(0) that its captures hold, root mean square over rings. Captures are counted "
    "through the shots and the phases of each."
)
_FRONTS = (
    "Each point is the best design of a search of its own over all that is free. Filled: no other "
    "point is as good for less, or better for as much. Steps: what is reached at each cost. "
    "Frequencies are looked at up to {:.4g} cycles/rad."
)


def page(config: DesignConfig, design: DesignScores) -> Page:
    """The page of a finished design."""
    masks = f"{'of the reference ' if config.frees('width') else ''}{config.mask.width:g} mm"
    light = f"λ = {config.wavelength * 1e6:g} nm"
    light += " for the reference" if config.frees("wavelength") else ""
    if config.noise.snr_db is not None:
        noise = f"Gaussian noise at {config.noise.snr_db:g} dB of each capture's variance"
    else:
        noise = f"{config.noise.electrons:g} electrons a mm² of open aperture and "
        noise += f"{config.noise.read_noise:g} of read noise"
    prior = number(design.objective.prior_exponent, 2)
    measured = ", as measured on the pictures" if config.prior.measured else ""
    lead = (
        f"{pixels_of(config.sensor)}, masks {masks} ({config.mask.profile}), object "
        f"{config.object.width:g} mm wide at {config.object.distance:g} mm, {light}, {noise}, "
        f"synthesis `{config.reference.synthesis}`. The scene's spectrum falls with the power "
        f"{prior} of frequency{measured}. Seed {config.seed}.",
        Sentences(findings(design)),
        *config.notes,
    )
    reference = design.reference.name
    pareto: tuple[Content, ...] = ()
    if design.pareto is not None:
        edge = design.pareto.highest_cycles_per_rad
        pareto = (Picture("pareto.png", "Pareto fronts", _FRONTS.format(edge)), *fronts(design))
    seeds = design.validation.seeds
    simulated = (
        "Full captures, Wiener synthesis, and PSNR after a least-squares gain and offset; mean ± "
        f"standard deviation over {seeds} seeds of the noise. Six elements of the chart halve the "
        "line pair. `found.yaml` is this comparison as a study for `thincam run`."
    )
    found = (
        _designs(design),
        _search(config, design),
        Picture("landscape.png", "Landscape of the objective", _LANDSCAPE),
        Picture("training.png", "Landscape of the training error", _TRAINING),
        Picture("responses.png", "Signal-to-noise ratio against frequency", _RESPONSES),
        Picture("mtf.png", "Modulation transfer against frequency", _TRANSFER.format(reference)),
    )
    parts = (
        Part("Images", _images(config, design)),
        Part("Designs found", found),
        Part("Simulated", (_simulated(config, design.validation), simulated)),
        Part("Pareto fronts", pareto),
    )
    return Page(lead, parts, command="design", warnings=design.warnings)


def _images(config: DesignConfig, design: DesignScores) -> list[Picture]:
    reference, best = design.reference.name, design.found[0].name
    shown = (
        f"the scene, and what {reference} and the designs found reconstruct at the first seed of "
        "the noise; below, the middle third, or of the chart its fine groups."
    )
    masks = (
        "The first mask of each shot, its transmission from 0 (black) to 1, and its PSF, from "
        f"black to its maximum: above {reference}, below {best}."
    )
    names = [target.name for target in config.targets]
    each = [
        Picture(f"reconstructions-{slug(name)}.png", f"{name}, reconstructed", f"{name}: {shown}")
        for name in names
    ]
    return [*each, Picture("masks.png", "Masks and PSFs", masks)]


def _designs(design: DesignScores) -> Table:
    """The reference, and the designs found with the tolerances of their numbers."""
    trained, reference = design.training is not None, design.reference
    free = [(value.variable, value.shots) for value in design.found[0].values]

    def row(one: Candidate, numbers: list[str], found: bool) -> list[str]:
        gains = [one.predicted_gain, *([one.training_gain_db] if trained else [])]
        reported = [number(one.reported, 3), *(signed(gain, 3) for gain in gains)]
        ended = one.status.replace("_", " ") if found else "–"
        return [one.name, *numbers, *reported, ended, "; ".join(one.active_limits) or "–"]

    rows = [row(reference, [reference.text(*each) for each in free], False)]
    rows += [row(one, [str(value) for value in one.values], True) for one in design.found]
    labels = (f"{REPORTED[name].of_shots(shots)}\n(tolerance)" for name, shots in free)
    gains = ("gain", *(("training\ngain, dB",) if trained else ()))
    headings = ("design", *labels, design.objective.label, *gains, "descent", "against limits")
    return Table(headings, rows, words=(len(headings) - 1,))


def _search(config: DesignConfig, design: DesignScores) -> str:
    """How the designs were found, what their tolerances mean, and how much was evaluated."""
    training, search = design.training, design.search
    if training:
        names, pixels = training.images, training.pixels
        how = (
            f"Where descents by the error of {len(names)} training images ({', '.join(names)}; "
            f"{pixels}×{pixels} pixels, reconstruction `{training.reconstruction}`) ended, "
            f"ranked by it; they began at the best of {training.samples} even samples, of the "
            "designs of the search and of the reference."
        )
    else:
        how = (
            "Local optima, ranked by the exact objective. The search descends on an approximation, "
            f"which is off by up to {search.approximation_off:.2g} {design.objective.unit} at "
            "these designs; the best few, and the best of the even samples, were then improved on "
            "the exact objective."
        )
    worse = "training error" if training else "objective"
    held = " (but for shots that take the rest of the exposure)" if config.frees("exposure") else ""
    counted = f"{search.evaluations} evaluations"
    if training:
        counted += f" of the objective, {training.evaluations} of the training error"
        failed = training.failed_descents
        counted += f" ({failed} descents met NaN)" if failed else ""
    failed = search.failed_starts
    counted += f"; at {failed} starts the objective was NaN" if failed else ""
    return (
        f"{how} Designs whose shots are only in another order are listed once. The tolerance of a "
        f"number is the change that makes the {worse} worse by 1\u00a0%, the others held{held}. "
        f"{counted}."
    )


def _simulated(config: DesignConfig, validation: Validation) -> Table:
    charts = validation.charts
    headings = ["design"]
    for target in config.targets:
        headings.append(f"{target.name}\nPSNR, gain, dB")
        headings += ["resolved mm,\ngain, elements"] if target.name in charts else []
    rows = []
    for number_of, (name, targets) in enumerate(validation.methods.items()):
        row = [name]
        for target in config.targets:
            found = targets[target.name]
            texts = [_spread(found.psnr_db, 2, ""), _spread(found.gain_db, 2)]
            row.append("\n".join(texts[: 2 if number_of else 1]))
            if target.name in charts:
                texts = [_resolved(found.resolved_object_mm), _spread(found.gain_elements, 1)]
                row.append("\n".join(texts[: 2 if number_of else 1]))
        rows.append([*row, number(targets[config.targets[0].name].object_pixel_mm, 4)])
    return Table([*headings, "object\npixel mm"], rows)


def _resolved(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return "–"
    ends = [f"{end:.2f}" for end in (min(known), max(known))]
    return " to ".join(ends if min(known) < max(known) else ends[:1])


def findings(design: DesignScores) -> list[str]:
    """What the numbers say, in sentences."""
    best, reference, validation = design.found[0], design.reference, design.validation
    names = reported_names([best, reference])
    by = "training" if design.training else design.objective.name
    sentences = [
        f"The best design by {by} is {' and '.join(best.words(names))}. The objective "
        f"predicts {best.predicted_gain:+.3g} {design.objective.unit} over {reference.name} "
        f"({' and '.join(reference.words(names))})."
    ]
    if best.training_gain_db is not None:
        sentences.append(f"On the training images it gains {best.training_gain_db:+.2f} dB.")
    broken = design.search.broken_limits
    sentences += [f"The reference breaks a limit: {why}." for why in broken]
    if best.active_limits:
        sentences.append(f"It lies against a limit: {'; '.join(best.active_limits)}.")
    for name, targets in validation.methods.items():
        gains = [
            f"{_worth(t.gain_db)} on {target}"
            for target, t in targets.items()
            if target in validation.pictures and t.gain_db
        ]
        if gains:
            sentences.append(f"Simulated, {name} gains {', '.join(gains)}.")
        for target, found in targets.items():
            if target in validation.charts and found.gain_elements:
                steps = _spread(found.gain_elements, 1)
                psnr = _worth(found.gain_db) if found.gain_db else "an exact image"
                sentences.append(f"On {target}, {name} resolves {steps} elements more, at {psnr}.")
    if not validation.one_object_grid:
        sentences.append(
            "The designs' largest distances differ, and with them the object's pixels (in the "
            "table below): their PSNR is not on one grid and compares to some tenths of a dB only."
        )
    return sentences


_LIMIT = (
    "Resolution is the frequency up to which every ring of frequencies has a signal-to-noise "
    "ratio of at least 1."
)


def fronts(design: DesignScores) -> list[Content]:
    """Of each Pareto front its table and a sentence."""
    known = {} if design.pareto is None else design.pareto.fronts
    every = (_front(name, front, design.reference.name) for name, front in known.items())
    return [content for front in every for content in front]


def _front(name: str, front: FrontScores, reference: str) -> tuple[Table, str]:
    names = reported_names([*front.points, front.reference])
    labels = [REPORTED[name].label for name in names]
    points = [(_cost(point.cost), point) for point in front.points]
    points.append((f"{reference}: {_cost(front.reference.cost)}", front.reference))
    pictures = tuple(front.points[0].simulated_psnr_db or ())

    def told(point: PointScores) -> tuple[str, ...]:
        if name == "captures":
            simulated = point.simulated_psnr_db or {}
            levels = (number(simulated.get(picture), 2) for picture in pictures)
            return (f"{point.predicted_psnr_db:.2f}", *levels)
        return (
            f"{point.resolution_cycles_per_rad:.1f}",
            f"{point.resolution_line_pairs_per_mm:.3f}",
            point.resolution_ends or "",
        )

    kept = {True: "no", False: "yes", None: ""}
    rows = [(text, *p.cells(names), *told(p), kept[p.dominated]) for text, p in points]
    if name != "captures":
        headings = ("cycles/rad", "line pairs/mm on the object", "", "front")
        title = f"{name.capitalize()} against resolution"
        return Table((front.label, *labels, *headings), rows, title=title), _LIMIT
    headings = ("predicted, dB", *(f"{picture}, dB" for picture in pictures), "front")
    note = (
        f"The exposure is {front.exposure}. Predicted from the error of the best "
        "linear reconstruction and the mean variance of the pictures; simulated in full at one "
        "seed. The front is that of the prediction. Where distances differ, so do the object's "
        "pixels, and simulated PSNR compares to some tenths of a dB only."
    )
    return Table((front.label, *labels, *headings), rows, title="Captures against PSNR"), note


def _cost(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"


def _worth(gain: Spread) -> str:
    """A gain of PSNR, and what it does to the error: "−1.06 dB (28 % more squared error)"."""
    change = 100 * (10 ** (-gain.mean / 10) - 1)
    word = "more" if change > 0 else "less"
    return f"{gain.text(2)} dB ({abs(change):.0f} % {word} squared error)"


def _spread(spread: Spread | None, digits: int, sign: str = "+") -> str:
    """Mean and standard deviation over the seeds; a dash where the images were exact."""
    return "–" if spread is None else spread.text(digits, sign)
