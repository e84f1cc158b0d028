"""Experiments of `kind: refocus`: the file, the study of its scene, its run and its page."""

from typing import Annotated, Literal

import numpy as np
import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax._core.text import slug
from thincam_jax.commands.report import Page, Part, Picture, Sentences, optics_of, pixels_of
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.schema import section
from thincam_jax.commands.sections import CamerasConfig, Name, TargetConfig, check_known
from thincam_jax.commands.study.build import assemble, cropped, with_targets
from thincam_jax.plot import refocus as plot
from thincam_jax.plot.frame import grey_levels, white_level
from thincam_jax.studies.refocus import (
    FocusRange,
    RefocusResult,
    RefocusRun,
    RefocusStudy,
    SceneObject,
    place,
    refocus_metrics,
)
from thincam_jax.studies.study import Study, Target

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

_PLACE = ("distance", "width", "x", "y")


class PlacedConfig(section(SceneObject, only=_PLACE), TargetConfig):
    """A picture that stands at a distance, its middle at (x, y), on a dark ground.

    Colours are averaged. `crop` takes the middle of a picture, that part of its shorter side.
    """

    crop: Annotated[float, Field(gt=0, le=1)] = 1.0


class SweepConfig(section(FocusRange)):
    """Distances and method of a sweep of the focus, and what is called sharp."""

    method: Name


class RefocusConfig(CamerasConfig):
    """A scene of several objects, captured once, and focused afterwards."""

    pictured = "objects"
    kind: Literal["refocus"]
    objects: Annotated[tuple[PlacedConfig, ...], Field(min_length=1)]
    sweep: SweepConfig
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _objects_fit(self):
        names = [method.name for method in self.methods]
        check_known(self.sweep.method, "method", names, "sweep", "method")
        for index, placed in enumerate(self.objects):
            if not self.sweep.nearest < placed.distance < self.sweep.farthest:
                message = (
                    f"{placed.distance:g} mm lies outside of the sweep; give a distance between "
                    f"{self.sweep.nearest:g} and {self.sweep.farthest:g} mm, or a wider sweep"
                )
                raise FieldError(message, "objects", index, "distance")
        return self


def build_refocus(config: RefocusConfig) -> RefocusStudy:
    """Cameras and methods, and the objects as targets at their distances.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """

    def read(study: Study | None, placed: PlacedConfig) -> Target | None:
        picture = cropped(placed)
        return study and place(study, 0, placed.build(name=placed.name, picture=picture))

    return RefocusStudy(with_targets(config, lambda: assemble(config), read), config.sweep.build())


def run_refocus(refocusing: RefocusStudy, folder: RunFolder, progress: Progress) -> RefocusResult:
    """Capture, sweep, reconstruct and report; the same configuration gives the same metrics."""
    return _RefocusRun(refocusing, folder).carry_out(progress).running.result


class _RefocusRun(Run):
    """A refocusing study and its report."""

    def __init__(self, refocusing: RefocusStudy, folder: RunFolder):
        super().__init__(refocusing.study.config, folder)
        self.running = RefocusRun(refocusing)
        self.work += self.running.work
        self.add("report", self.report)

    def report(self) -> None:
        folder, result = self.folder, self.running.result
        study = result.refocusing.study
        self.metrics = {"study": study.name, "kind": self.config.kind, "seed": study.seed}
        self.metrics |= refocus_metrics(result) | {"warnings": study.warnings}
        places = {name: one.distance_mm for name, one in result.objects.items()}
        folder.save_figure("sweep", plot.draw_sweep(result.sweep, places))
        folder.write("figures/sweep.webp", plot.animate_sweep(result.sweep))
        folder.save_figure("focus", plot.draw_curves(result))
        white = white_level(np.asarray(result.sweep.images))
        folder.save_image("all-in-focus", grey_levels(result.sharp, white))
        folder.save_figure("depth", plot.draw_depth(result.sweep, result.depth, result.sharp))
        for (name, distance), image in result.images.items():
            shown = grey_levels(image, white_level(image))
            folder.save_image(f"{slug(name)}--{distance:g}mm", shown)
        folder.save_figure("methods", plot.draw_methods(result))
        self.complete(page(self.config, result))


def page(config: RefocusConfig, result: RefocusResult) -> Page:
    """The page of a finished run."""
    first, *others = result.findings()
    lead = f"{pixels_of(config.sensor)}, mask {config.mask.label}, {optics_of(config)}"
    curves = (
        f"Focus measure of each object in the sweep by {config.sweep.method}; vertical lines: "
        "where the objects were placed."
    )
    sweep = (
        Picture("sweep.png", "The scene focused on distances", _SWEEP),
        Picture("sweep.webp", "The scene refocused", "The whole sweep, there and back."),
    )
    depth = Picture("depth.png", "Depth map, confidence, all in focus", _DEPTH)
    methods = Picture("methods.png", "All methods at all distances", _METHODS)
    found = (result.table(), Sentences(others), Picture("focus.png", "Focus curves", curves))
    parts = (
        Part("Distances", found),
        Part("Sweep", sweep),
        Part("Depth", (depth,)),
        Part("Methods", (result.methods_table(), _SCORED, methods)),
        Part("Notes", config.notes),
    )
    return Page((lead,), parts, "run", result.refocusing.study.warnings, first)
