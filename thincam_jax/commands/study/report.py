"""The report of a study: every method on every target, beside what was published."""

from thincam_jax._core.table import Table, number
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.report import Page, Part, Picture, Sentences, optics_of, pixels_of
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.studies.result import StudyScores

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
    "Response of each method's synthesis with the finite mask, over its low-frequency value. "
    "Nyquist: 1/(2 pitch) of the pixels; what lies beyond it, in grey, no capture holds."
)
_CONTRAST = (
    "Contrast of the chart's elements in the reconstructions; below zero the bars are reversed."
)


def page(config: StudyConfig, scores: StudyScores, sentences: list[str]) -> Page:
    """The page of a finished study; `sentences` say what its numbers do."""
    seen = config.object
    moves = f" that moves {seen.motion:g} mm across during an exposure of 1" if seen.motion else ""
    lead = (
        f"{pixels_of(config.sensor)}, mask {config.mask.label}, object {seen.width:g} mm wide at "
        f"{seen.distance:g} mm{moves}, {optics_of(config)}"
    )
    names = [target.name for target in config.targets]
    pictures = [picture for name in names for picture in _pictures(name)]
    transfer = (
        Picture("mtf.png", "Transfer functions of all methods", _TRANSFER),
        Picture("contrast.png", "Contrast of chart elements", _CONTRAST),
    )
    published = (Sentences(sentences), *config.notes) if sentences or config.notes else ()
    parts = (
        Part("Reconstructions", pictures),
        Part("Results", (_quality(names, scores), _SCORED)),
        Part("Resolution", (_resolution(scores), _RESOLVED)),
        Part("Beside the published figures", published),
        Part("Transfer functions", transfer),
        Part(
            "Point spread function",
            (Picture("psf.png", "Point spread function", "Of the first capture."),),
        ),
    )
    return Page((lead,), parts, warnings=scores.warnings)


def _pictures(name: str) -> tuple[Picture, Picture]:
    """Of a target."""
    shown = "the first raw capture, the scene, and the reconstructions; below, the middle third, "
    captures = "Each from black to its own maximum; β and φ of the mask, d from mask to sensor."
    return (
        Picture(
            f"target-{slug(name)}.png", name, f"{name}: {shown}or of the chart its fine groups."
        ),
        Picture(
            f"captures-{slug(name)}.png",
            f"All captures of {name}",
            captures,
            folded=f"all captures of {name}",
        ),
    )


def _quality(targets: list[str], scores: StudyScores) -> Table:
    rows = []
    for name, one in scores.methods.items():
        found = [one.targets[target] for target in targets]
        both = [f"{number(s.psnr_db, 1)} / {number(s.ssim, 2)}" for s in found]
        means = one.mean_psnr_of_pictures_db, one.published.psnr_db
        rows.append((name, one.captures, *both, *means))
    each = (f"{target}\nPSNR dB / SSIM" for target in targets)
    headings = ("method", "captures", *each, "mean PSNR of\npictures, dB", "published\ndB")
    return Table(headings, rows, (1,) * (len(headings) - 1), published=(len(headings) - 1,))


def _resolution(scores: StudyScores) -> Table:
    rows = []
    for name, one in scores.methods.items():
        resolved, limits, published = one.resolved, one.limits, one.published
        rows.append(
            (
                name,
                resolved and resolved.object_mm,
                resolved and resolved.sensor_cycles_per_mm,
                published.resolved_object_mm,
                limits.first_zero_cycles_per_mm,
                limits.cut_off_cycles_per_mm,
                limits.cut_off_object_mm,
                published.limit_cycles_per_mm,
            )
        )
    headings = (
        "method",
        "resolved line pair\non the object, mm",
        "the same on the\nsensor, cycles/mm",
        "published\nmm",
        "first zero\ncycles/mm",
        "cut-off\ncycles/mm",
        "cut-off on\nthe object, mm",
        "published limit\ncycles/mm",
    )
    return Table(headings, rows, (2, 1, 2, 2, 1, 2, 1), published=(3, 7))
