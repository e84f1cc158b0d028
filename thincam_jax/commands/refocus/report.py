"""The report of a refocusing: where objects stand, the sweep, and every method focused on each."""

from thincam_jax._core.table import Table, number
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.report import Page, Part, Picture, Sentences, optics_of, pixels_of
from thincam_jax.studies.refocus import RefocusResult

_SWEEP = (
    "Reconstructions from the same captures, focused on the distance above each; one grey scale "
    "for all. In bold those nearest to an object. A pixel is the same direction in all of them."
)
_DEPTH = (
    "Left: the distance at which the surroundings of each pixel are sharpest. Right: each pixel "
    "from the image focused on its distance."
)
_SCORED = (
    "PSNR is taken within an object's outline, after a least-squares gain and offset of its own, "
    "against the object averaged over the same pixels."
)
_METHODS = (
    "Solid box: in focus; dotted: out of focus. Below each picture the middle of both objects, "
    "that in focus framed. Each picture has its own white."
)


def page(config: RefocusConfig, result: RefocusResult, sentences: list[str]) -> Page:
    """The page of a finished run; `sentences` say what its numbers do."""
    lead = f"{pixels_of(config.sensor)}, mask {config.mask.label}, {optics_of(config)}"
    curves = (
        f"Focus measure of each object in the sweep by {config.sweep.method}; vertical lines: "
        "where the objects were placed."
    )
    sweep = (
        Picture("sweep.png", "Contact sheet of the sweep", _SWEEP),
        Picture("sweep.webp", "Animation of the sweep", "The whole sweep, there and back."),
    )
    depth = Picture("depth.png", "Depth map, confidence, all in focus", _DEPTH)
    methods = Picture("methods.png", "All methods at all distances", _METHODS)
    found = (_distances(result), Sentences(sentences), Picture("focus.png", "Focus curves", curves))
    parts = (
        Part("Distances", found),
        Part("Sweep", sweep),
        Part("Depth", (depth,)),
        Part("Methods", (_methods(config, result), _SCORED, methods)),
        Part("Notes", config.notes),
    )
    return Page((lead,), parts, warnings=result.refocusing.study.warnings)


def _distances(result: RefocusResult) -> Table:
    rows = [
        (
            name,
            f"{found.distance_mm:g}",
            number(found.found_mm, 1),
            found.error_percent,
            found.axial_resolution_mm,
        )
        for name, found in result.objects.items()
    ]
    headings = ("object", "placed at\nmm", "found at\nmm", "error\n%", "depth of focus\nmm")
    return Table(headings, rows, (0, 1, 1, 0))


def _methods(config: RefocusConfig, result: RefocusResult) -> Table:
    rows = []
    for name, method in result.methods.items():
        for distance, one in method.focused_on_mm.items():
            psnr = (one.psnr_db[placed.name] for placed in config.objects)
            count = None if one.iterations is None else f"{one.iterations} ({one.status})"
            rows.append((name, method.captures, distance, *psnr, count))
    each = (f"{placed.name} at {placed.distance:g} mm\nPSNR dB" for placed in config.objects)
    headings = ("method", "captures", "focused on\nmm", *each, "iterations")
    return Table(headings, rows, (1,) * (len(headings) - 1))
