"""Running a study: every target through every method, into a run folder with a report."""

from dataclasses import asdict

from thincam_jax._core.text import slug
from thincam_jax.commands.report import (
    Gallery,
    Page,
    Part,
    Picture,
    Sentences,
    optics_of,
    pixels_of,
)
from thincam_jax.commands.run_folder import Progress, Run, RunFolder, as_record
from thincam_jax.commands.sections import StudyConfig
from thincam_jax.imaging.encoding import as_picture
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.plot import studies as plot
from thincam_jax.studies.evaluate import (
    Capture,
    Contrasts,
    Evaluation,
    Scores,
    evaluate_method,
    take,
)
from thincam_jax.studies.result import Response, StudyScores, findings, method_response, summarise
from thincam_jax.studies.study import Method, Study, Target

_SCORED = (
    "PSNR and SSIM are taken after a least-squares gain and offset, over the target's area, "
    "against the scene averaged over the same pixels."
)
_RESOLVED = (
    "An element counts as resolved when every bar stands out from every gap, in both directions, "
    "by a tenth of the chart's contrast, and so do all coarser elements. The first zero is the "
    "lowest frequency that none of a method's captures carries; the cut-off is where the transfer "
    "function stays under 5\u00a0% of its low-frequency value. Frequencies are on the sensor plane "
    "of the method's largest mask–sensor distance."
)
_TRANSFER = (
    "Response of each method's synthesis with the finite mask, over its low-frequency value. Above "
    "1 (a title says how far) fringes of the mask's edge or of several captures add up to more. "
    "Each panel has its own range. Grey: beyond the Nyquist frequency, which no capture holds."
)
_CONTRAST = (
    "Contrast of the chart's elements in the reconstructions; below zero the bars are reversed."
)


def run_study(study: Study, folder: RunFolder, progress: Progress) -> StudyScores:
    """Run what the folder does not hold yet; returns (and writes) the scores.

    The same configuration gives the same scores: every capture's noise has its own key, from the
    seed and the capture's place in the study.
    """
    return _StudyRun(study, folder).carry_out(progress).scores


class _StudyRun(Run):
    """A study on its way; `evaluations` are those of the target at hand, by method."""

    scores: StudyScores

    def __init__(self, study: Study, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study = study
        self.captures: dict[Exposure, Capture] = {}
        self.evaluations: dict[str, Evaluation] = {}
        self.found: dict[str, dict[str, Scores]] = {}  # by target and method
        self.contrasts: dict[str, dict[str, Contrasts]] = {}
        self.responses: dict[str, Response] = {}
        for target in study.targets:
            stored = folder.finished(target.name)
            if stored is not None:
                self.found[target.name] = as_record(dict[str, Scores], stored["metrics"])
                self.contrasts[target.name] = as_record(dict[str, Contrasts], stored["contrasts"])
                continue
            for count, exposure in enumerate(study.exposures, 1):
                self.add(f"{target.name}: capture {count}", self.capture, target, exposure)
            for method in study.methods:
                self.add(f"{target.name}: {method.name}", self.reconstruct, target, method)
        for method in study.methods:
            self.add(f"transfer function of {method.name}", self.transfer, method)
        self.add("report", self.report)

    def capture(self, target: Target, exposure: Exposure) -> None:
        self.captures[exposure] = take(self.study, exposure, target)

    def reconstruct(self, target: Target, method: Method) -> None:
        found = evaluate_method(self.study, method, target, self.captures)
        self.evaluations[method.name] = found
        if method is self.study.methods[-1]:
            self.finish(target)

    def finish(self, target: Target) -> None:
        study, folder, found = self.study, self.folder, self.evaluations
        self._save_images(target)
        # No target's name can be taken for one of the study's own figures.
        figure = plot.draw_captures(study, self.captures)
        folder.save_figure(f"captures-{slug(target.name)}", figure)
        contrasts = {name: e.contrast for name, e in found.items() if e.contrast is not None}
        scores = {name: e.scores for name, e in found.items()}
        self.found[target.name], self.contrasts[target.name] = scores, contrasts
        metrics = {name: asdict(one) for name, one in scores.items()}
        folder.finish(target.name, {"metrics": metrics, "contrasts": contrasts})
        self.captures, self.evaluations = {}, {}

    def _save_images(self, target: Target) -> None:
        """A target's scene and all reconstructions of it."""
        place, folder = slug(target.name), self.folder
        raw = as_picture(self.captures[self.study.exposures[0]].image)
        folder.save_image(f"{place}--capture", raw / raw.max())
        shown = {"scene": plot.truth_of(self.evaluations)}
        shown |= {name: evaluation.image for name, evaluation in self.evaluations.items()}
        for name, light in shown.items():
            image = target.shown(light)
            folder.save_image(f"{place}--{slug(name)}", image)
            folder.save_image(
                f"{place}--{slug(name)}--detail", plot.enlarged_part(image, target)[0]
            )

    def transfer(self, method: Method) -> None:
        self.responses[method.name] = method_response(self.study, method)

    def report(self) -> None:
        study, folder = self.study, self.folder
        self.scores = summarise(study, study.targets, self.found, self.responses)
        self.metrics = asdict(self.scores)
        folder.save_figure("mtf", plot.draw_responses(study, self.responses))
        # Of several charts the last.
        contrasts: dict[str, Contrasts] = {}
        for target in study.targets:
            contrasts |= self.contrasts[target.name]
        if contrasts:
            folder.save_figure("contrast", plot.draw_contrasts(contrasts))
        folder.save_figure("psf", plot.draw_psf(study))
        self.complete(page(study.config, self.scores, findings(study, self.scores)))


def page(config: StudyConfig, scores: StudyScores, sentences: list[str]) -> Page:
    """The page of a finished study; `sentences` say what its numbers do."""
    seen = config.object
    moves = f" that moves {seen.motion:g} mm across during an exposure of 1" if seen.motion else ""
    lead = (
        f"{pixels_of(config.sensor)}, mask {config.mask.label}, object {seen.width:g} mm wide at "
        f"{seen.distance:g} mm{moves}, {optics_of(config)}"
    )
    first, *others = (_pictures(target.name, scores) for target in config.targets)
    transfer = (
        Picture("mtf.png", "Transfer functions of all methods", _TRANSFER),
        Picture("contrast.png", "Contrast of chart elements", _CONTRAST),
    )
    psf = (
        Picture(
            "psf.png",
            "Point spread function",
            "The first capture's PSF, and a line through its middle.",
        ),
    )
    published = (Sentences(sentences), *config.notes) if sentences or config.notes else ()
    parts = (
        Part("Other reconstructions", [picture for pictures in others for picture in pictures]),
        Part("Results", (scores.quality_table(), _SCORED)),
        Part("Resolution", (scores.resolution_table(), _RESOLVED)),
        Part("Beside the published figures", published),
        Part("Transfer functions", transfer),
        Part("Point spread function", psf),
    )
    result, *sentences = sentences or [""]
    beginning = (*first, scores.table(), lead)
    return Page(beginning, parts, warnings=scores.warnings, result=result)


def _pictures(target: str, scores: StudyScores) -> tuple[Gallery, Gallery, Picture]:
    """Pictures of a target: whole, enlarged, and all captures, folded."""
    place = f"../images/{slug(target)}--"
    wholes = [
        Picture(f"{place}capture.png", f"{target} as shadows of the mask", "first raw capture"),
        Picture(f"{place}scene.png", f"{target}, the scene", f"{target}, the scene"),
    ]
    details = [Picture(f"{place}scene--detail.png", f"Part of {target}", "scene, enlarged")]
    for name, method in scores.methods.items():
        found = method.targets[target].words
        alt = f"{target} by {name}: {found}"
        wholes.append(Picture(f"{place}{slug(name)}.png", alt, f"{name}\n{found}"))
        file = f"{place}{slug(name)}--detail.png"
        details.append(Picture(file, f"Part of {alt}", f"{name}, enlarged"))
    captures = "Each from black to its own maximum; β and φ of the mask, d from mask to sensor."
    file = f"captures-{slug(target)}.png"
    folded = Picture(file, f"All captures of {target}", captures, f"all captures of {target}")
    return Gallery(wholes), Gallery(details), folded
