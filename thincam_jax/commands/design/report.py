"""The report of a design: designs found, their simulation, fronts."""

from thincam_jax._core.table import number
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.report import Content, Page, Part, Picture, Sentences, pixels_of
from thincam_jax.studies.design_scores import DesignScores

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
    first, *others = design.findings()
    prior = number(design.objective.prior_exponent, 2)
    measured = ", as measured on the pictures" if config.prior.measured else ""
    lead = (
        f"{pixels_of(config.sensor)}, masks {masks} ({config.mask.profile}), object "
        f"{config.object.width:g} mm wide at {config.object.distance:g} mm, {light}, {noise}, "
        f"synthesis `{config.reference.synthesis}`. The scene's spectrum falls with the power "
        f"{prior} of frequency{measured}. Seed {config.seed}.",
        Sentences(others),
        *config.notes,
    )
    reference = design.reference.name
    pareto: tuple[Content, ...] = ()
    if design.pareto is not None:
        edge = design.pareto.highest_cycles_per_rad
        pareto = (Picture("pareto.png", "Pareto fronts", _FRONTS.format(edge)), *fronts(design))
    seeds = design.validation.seeds
    simulated = (
        f"Full captures, reconstruction by {config.validation.reconstruction}, and PSNR after a "
        f"least-squares gain and offset; mean ± standard deviation over {seeds} seeds of the "
        "noise. Six elements of the chart halve the line pair. `found.yaml` is this comparison as "
        "a study for `thincam run`."
    )
    found = (
        design.designs_table(),
        _search(config, design),
        Picture("landscape.png", "Landscape of the objective", _LANDSCAPE),
        Picture("training.png", "Landscape of the training error", _TRAINING),
        Picture("responses.png", "Signal-to-noise ratio against frequency", _RESPONSES),
        Picture("mtf.png", "Modulation transfer against frequency", _TRANSFER.format(reference)),
    )
    parts = (
        Part("Images", _images(config, design)),
        Part("Designs found", found),
        Part("Simulated", (design.validation.table(), simulated)),
        Part("Pareto fronts", pareto),
    )
    return Page(lead, parts, "design", design.warnings, first)


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


def _search(config: DesignConfig, design: DesignScores) -> str:
    """Search of the designs, meaning of their tolerances, and number of evaluations."""
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


_CAPTURES = (
    "The exposure is {}. Predicted from the error of the best linear reconstruction and the mean "
    "variance of the pictures; simulated in full at one seed. The front is that of the prediction. "
    "Where distances differ, so do the object's pixels, and simulated PSNR compares to some tenths "
    "of a dB only."
)
_LIMIT = (
    "Resolution is the frequency up to which every ring of frequencies has a signal-to-noise "
    "ratio of at least 1."
)


def fronts(design: DesignScores) -> list[Content]:
    """Table and sentence of each Pareto front."""
    contents: list[Content] = []
    for name, front in ({} if design.pareto is None else design.pareto.fronts).items():
        note = _CAPTURES.format(front.exposure) if name == "captures" else _LIMIT
        contents += [front.table(name, design.reference.name), note]
    return contents
