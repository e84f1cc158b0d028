"""Running a design: the search, the simulation of the designs found, and a report."""

from collections.abc import Iterable
from dataclasses import asdict, astuple, dataclass
from functools import cached_property, partial
from typing import Any

from thincam_jax._core.table import number
from thincam_jax._core.text import slug
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design.build import as_study_config
from thincam_jax.commands.design.config import DesignConfig, DesignNoiseConfig
from thincam_jax.commands.report import Content, Page, Part, Picture, Sentences, pixels_of
from thincam_jax.commands.run_folder import Progress, Run, RunFolder, Step, as_record
from thincam_jax.design.search import NonFiniteObjectiveError
from thincam_jax.plot import design as plot
from thincam_jax.plot.frame import as_png
from thincam_jax.plot.studies import draw_found
from thincam_jax.studies.design import DesignSearch, DesignStudy, FrontSearches
from thincam_jax.studies.design_result import DesignResult
from thincam_jax.studies.design_scores import DesignScores
from thincam_jax.studies.evaluate import Evaluation, Scores
from thincam_jax.studies.study import Study, Target
from thincam_jax.studies.trials import Trials, simulate_trials

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
    first, *others = design.findings()
    prior = number(design.objective.prior_exponent, 2)
    measured = ", as measured on the pictures" if config.prior.measured else ""
    lead = (
        f"{pixels_of(config.sensor)}, masks {masks} ({config.mask.profile}), object "
        f"{config.object.width:g} mm wide at {config.object.distance:g} mm, {light}, "
        f"{noise_of(config.noise)}, synthesis `{config.reference.synthesis}`. The scene's spectrum "
        f"falls with the power {prior} of frequency{measured}. Seed {config.seed}.",
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


def noise_of(noise: DesignNoiseConfig) -> str:
    """Noise of a design's file, in words."""
    if noise.snr_db is not None:
        return f"Gaussian noise at {noise.snr_db:g} dB of each capture's variance"
    light = f"{noise.electrons:g} electrons a mm² of open aperture"
    return f"{light} and {noise.read_noise:g} of read noise"


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


class DesignFolder(RunFolder):
    """Files of one design, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `found.yaml`: the reference and the best designs, for `thincam run`.
    - `targets/NAME.json`: the simulation of a finished target; an interrupted design skips these.
    - `reconstructions-NAME.png`: reconstructions of a target's scene, written with its simulation.
    - `masks.png`, `landscape.png`, `training.png`, `responses.png`, `mtf.png`, `pareto.png`,
      `environment.json`, `html`, `design.json`: written at the end.
    """

    kind, folders, pictures, result = "design", ("targets",), "", "design.json"


def run_design(design: DesignStudy, folder: DesignFolder, progress: Progress) -> DesignScores:
    """Search, simulate and report; returns (and writes) what goes into design.json.

    The same configuration gives the same on the same machine.
    """
    return _DesignRun(design, folder).carry_out(progress).scores


@dataclass(frozen=True)
class FinishedTarget:
    """Simulation of a target: the exposures of each design, and the scores of each seed."""

    designs: list[list[list[Any]]]
    trials: dict[str, list[Scores]]


class _DesignRun(Run):
    """A design on its way: search, simulation of each target, fronts."""

    config: DesignConfig
    scores: DesignScores

    def __init__(self, design: DesignStudy, folder: DesignFolder):
        super().__init__(design.study.config, folder)
        self.design, self.search, self.fronts = design, DesignSearch(design), None
        self.trials: dict[str, Trials] = {}
        self.work += _blaming("search", self.search.searching)
        self.work += _blaming("train", self.search.training)
        self.work += self.search.ranking
        for target in design.study.targets:
            self.add(target.name, self.simulate, target)
        if design.fronts is not None:
            self.fronts = FrontSearches(design, design.fronts)
            self.work += _blaming("pareto", self.fronts.work)
        self.add("report", self.report)

    @cached_property
    def simulated(self) -> Study:
        """The designs of the file and the best of those found."""
        return self.design.simulated(self.search.result)

    def simulate(self, target: Target) -> None:
        """Simulate a target, or read its trials from before an interruption of these designs."""
        methods = self.simulated.methods
        self.folder.write("found.yaml", dump_config(as_study_config(self.config, methods)))
        designs = [[list(astuple(e)) for e in method.exposures] for method in methods]
        held = self.folder.finished(target.name)
        stored = None if held is None else as_record(FinishedTarget, held)
        if stored is None or stored.designs != designs:
            shown: dict[str, Evaluation] = {}
            trials = simulate_trials(self.simulated, target, self.design.seeds, shown)
            figure = draw_found(target, shown)
            self.folder.write(f"reconstructions-{slug(target.name)}.png", as_png(figure))
            stored = FinishedTarget(designs, trials)
            self.folder.finish(target.name, asdict(stored))
        self.trials[target.name] = stored.trials

    def report(self) -> None:
        found, design, folder = self.search.result, self.design, self.folder
        fronts = None if self.fronts is None else self.fronts.result()
        self.scores = DesignResult(design, found, self.trials, fronts).scores
        self.metrics = asdict(self.scores)
        count, distance = design.best, design.study.object_distance
        pictures = {
            "masks.png": plot.draw_masks(self.simulated, found.found[0].name),
            "landscape.png": plot.draw_objective(found, count),
            "training.png": plot.draw_training(found, count),
            "responses.png": plot.draw_responses(found, count, self.config.sensor.pitch),
            "mtf.png": plot.draw_mtf(found, distance),
        }
        if (pareto := self.scores.pareto) is not None:
            pictures["pareto.png"] = plot.draw_fronts(pareto, found.reference.name, distance)
        for name, figure in pictures.items():
            if figure is not None:
                folder.write(name, as_png(figure))
        self.complete(page(self.config, self.scores))


def _blaming(section: str, steps: Iterable[Step]) -> list[Step]:
    """Steps that report an objective that is NaN at every start as a fault of a section."""

    def do(step: Step) -> None:
        try:
            step.do()
        except NonFiniteObjectiveError as error:
            raise ConfigError(f"{section}: {error}") from None

    return [Step(step.text, partial(do, step)) for step in steps]
