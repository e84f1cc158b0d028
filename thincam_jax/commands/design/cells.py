"""Experiments of `kind: cells`: masks whose every cell is free; the file, its run and its page."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Annotated, Any, Literal

import pydantic

from thincam_jax._core.quantity import FieldError, quantities
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design.config import DesignNoiseConfig, PixelsConfig
from thincam_jax.commands.design.config_pareto import ONCE
from thincam_jax.commands.design.run import DesignFolder, noise_of
from thincam_jax.commands.mask import Index
from thincam_jax.commands.report import Page, Part, Picture, Sentences, pixels_of
from thincam_jax.commands.run_folder import Progress, Run, as_record
from thincam_jax.commands.schema import Wavelength, section
from thincam_jax.commands.sections import ExperimentConfig, ObjectConfig
from thincam_jax.design import PhotonNoise, SignalNoise
from thincam_jax.design.cell_files import write_cells
from thincam_jax.design.cell_masks import CellMasks
from thincam_jax.design.cell_search import FLIPPED, CellSettings
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.recommendation import KINDS
from thincam_jax.design.setup import PowerLaw, Setup
from thincam_jax.plot.design import draw_cells
from thincam_jax.plot.frame import as_png
from thincam_jax.studies.cells import CellScores, CellStudy, KindScores

_STATE = "targets"  # of an interrupted run
_DRAWN = (
    "Masks found, from black (closed, or no phase) to white (open, or a turn), and the part of "
    "their PSFs on the axis that holds 95 % of the light."
)
_STUDY = "A study judges a mask on photographs: `mask: {{family: {}, path: {}, width: {:g} mm}}`."
_ERRORS = (
    "Expected error: the part of the scene's variance that the best linear image lacks, over the "
    "field. No mask that casts a shadow is below the limit of shadows; masks that focus can be. "
    "The limit is that of exact masks, at the object's distance alone. PSFs are those on the axis: "
    "off it masks that focus lose more."
)


class FreeMaskConfig(section(CellMasks, without=("wavelength",))):
    """Masks of cells, see `design.CellMasks`; `index`: refractive index of a relief of phases."""

    index: Index = 1.52


class ScenePriorConfig(section(PowerLaw, Setup, only=("exponent", "corner", "contrast"))):
    """The scene's spectrum, a power law, and the standard deviation of the scene over its mean."""


class ErrorsConfig(section(Tolerances, without=("beta",))):
    """Standard deviations of what images are made for, see `design.objectives.Tolerances`."""


class CellSearchConfig(section(CellSettings, without=("seed",))):
    """Length of the search, and what the error is the mean over."""

    tolerances: ErrorsConfig = ErrorsConfig()


class FreeCellsConfig(ExperimentConfig):
    """A search for masks whose every cell is free; `compare`: kinds of mask to set beside them."""

    pictured = ""
    kind: Literal["cells"]
    wavelength: Wavelength
    sensor: PixelsConfig
    mask: FreeMaskConfig
    object: ObjectConfig
    noise: DesignNoiseConfig
    prior: ScenePriorConfig = ScenePriorConfig()
    search: CellSearchConfig = CellSearchConfig()
    compare: Annotated[tuple[Literal[tuple(KINDS)], ...], ONCE] = (  # pyright: ignore
        tuple(KINDS)
    )
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if not self.search.lone_cells and (self.mask.rings or self.mask.levels not in FLIPPED):
            message = f"false is for levels {' or '.join(FLIPPED)} without rings; drop it"
            raise FieldError(message, "search", "lone_cells")
        for place, make in (("mask", self.space), ("object", self.setup)):
            try:
                make()
            except ValueError as error:
                raise FieldError(str(error), place) from None
        return self

    def space(self) -> CellMasks:
        return self.mask.build(wavelength=self.wavelength)

    def setup(self) -> Setup:
        return Setup(
            self.sensor.pitch,
            min(self.sensor.shape) * self.sensor.pitch,
            self.object.distance,
            self.object.width,
            self.prior.contrast,
            self.noise.build(PhotonNoise if self.noise.snr_db is None else SignalNoise),
            self.prior.build(PowerLaw),
        )


def build_cells(config: FreeCellsConfig) -> CellStudy:
    """All that a search needs.

    **Errors**: ConfigError for tolerances that are too large; MemoryError for too many cells.
    """
    settings = config.search.build(CellSettings, seed=config.seed)
    tolerances = config.search.tolerances.build()
    study = CellStudy(config.setup(), config.space(), settings, tolerances, config.compare, config)
    try:
        study.judge()
    except ValueError as error:
        place = config.place_of("search", "tolerances")
        raise ConfigError(f"{place}search.tolerances: {error}") from None
    return study


def run_cells(study: CellStudy, folder: DesignFolder, progress: Progress) -> CellScores:
    """Compare, search and report; an interrupted run goes on from its folder."""
    return _CellsRun(study, folder).carry_out(progress).scores


class _CellsRun(Run):
    """Limit, kinds and search on their way; what is finished is kept in the folder."""

    scores: CellScores

    def __init__(self, study: CellStudy, folder: DesignFolder):
        super().__init__(study.config, folder)
        self.study, self.kinds, self.least = study, [], None
        self.add("limit of shadows", self.bound)
        for kind in study.kinds:
            self.add(kind, self.compare, kind)
        self.add("search", self.search)
        self.add("report", self.report)

    def bound(self) -> None:
        self.least = self.study.limit_db()

    def compare(self, kind: str) -> None:
        held = self.folder.finished(kind)
        if held is None:
            held = {"best": [asdict(one) for one in self.study.best_of(kind)]}
            self.folder.finish(kind, held)
        self.kinds += as_record(list[KindScores], held["best"])

    def search(self) -> None:
        try:
            self.found = self.study.find(self.folder.path / _STATE)
        except ValueError as error:  # of a state that is damaged
            raise ConfigError(str(error)) from None

    def report(self) -> None:
        study, found, folder = self.study, self.found, self.folder
        self.scores = study.scores(found, self.least, self.kinds)
        files = write_cells(folder.path, found, index=self.config.mask.index)
        folder.write("masks.png", as_png(draw_cells(found, *study.psfs(found))))
        about = {"name": self.config.name, "kind": self.config.kind, "seed": self.config.seed}
        self.metrics = about | asdict(self.scores) | {"files": files}
        self.complete(page(self.config, self.scores, files))


def page(config: FreeCellsConfig, scores: CellScores, files: dict[str, str]) -> Page:
    """The page of a finished run."""
    first, *others = scores.findings()
    mask, off = config.mask, config.search.tolerances
    captures = f", {mask.captures} captures" if mask.captures > 1 else ""
    lead = (
        f"{pixels_of(config.sensor)}; masks of {mask.count}×{mask.count} cells of "
        f"{1000 * mask.cell:g} µm, levels `{mask.levels}`{captures}, {mask.distance:g} mm before "
        f"it; object {config.object.width:g} mm wide at {config.object.distance:g} mm, "
        f"λ = {config.wavelength * 1e6:g} nm, {noise_of(config.noise)}. Seed {config.seed}.",
        _mean_over(config.search.depths, dict(off)),
        Sentences(others),
        *config.notes,
    )
    family = "phase" if "phase" in mask.levels else "file"
    named = [f"`{name}`: {text}." for name, text in files.items()]
    parts = (
        Part("Masks found", (Picture("masks.png", "Masks and PSFs", _DRAWN),)),
        Part("Beside other masks", (scores.table(), _ERRORS)),
        Part(
            "Files for a shop",
            (Sentences(named), _STUDY.format(family, [*files][0], mask.count * mask.cell)),
        ),
    )
    return Page(lead, parts, "design", result=first)


def _mean_over(depths: tuple[float, ...], tolerances: Mapping[str, float]) -> str:
    """Depths and tolerances that errors are means over, in a sentence; empty without any."""
    known = quantities(Tolerances)
    over = [f"± {known[key].text(off)} of {key}" for key, off in tolerances.items() if off]
    if depths:
        over.insert(0, f"distances of {', '.join(f'{one:g}' for one in depths)} mm")
    text = "Errors are means over {}, of images made for the middle."
    return text.format(", ".join(over).replace("_", " ")) if over else ""


def work(asked: FreeCellsConfig, setup: Any) -> Iterator[str]:
    """Kinds that are compared, and evaluations of a search."""
    mask, settings = asked.mask, asked.search.build(CellSettings)
    yield f"other kinds of mask: {len(asked.compare)}, each by its best of some twelve"
    yield (
        f"search: {mask.captures} × {mask.count}² cells, {settings.draws} random masks, then "
        f"gradients, each counted as three: at most {settings.most} evaluations"
    )
