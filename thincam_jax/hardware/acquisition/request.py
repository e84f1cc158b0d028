"""A plan of captures given by its numbers, checked before any device is opened."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args

import numpy as np

from thincam_jax._core.quantity import FieldError, check_fields, choice, quantity, whole
from thincam_jax.hardware import plans
from thincam_jax.hardware.acquisition.plan import WHITE, AcquisitionPlan, Pattern
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.lensless.exposures import Layout
from thincam_jax.lensless.masks.fza import PROFILES, Profile
from thincam_jax.measured.calibration.alignment import MapKind
from thincam_jax.measured.calibration.hadamard import DARK_FRAMES, Display, HadamardSeries, Order

PlanKind = Literal[
    "fringe_scan",
    "method_a",
    "method_b",
    "psf_stack",
    "hadamard",
    "pictures",
    "scene",
    "grey_levels",
    "alignment",
]
MONITOR = "hadamard", "pictures", "alignment"  # plans of a monitor
SHOWN = "scene", "psf_stack"  # plans of one mask of any kind
ANYTHING = "scene", "grey_levels"  # plans before which anything may stand
# What each kind needs, and what it may have beside the dark frames.
_ZONES = ("betas", "width")
_NUMBERS: dict[PlanKind, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "fringe_scan": (_ZONES, ("profile", "mosaic")),
    "method_a": ((*_ZONES, "distances"), ("profile",)),
    "method_b": (_ZONES, ("profile", "mosaic")),
    "psf_stack": (("distances",), (*_ZONES, "profile", "phase")),
    "hadamard": (("cells",), ("order", "display")),
    "pictures": (("cells",), (*_ZONES, "profile", "phase", "frames")),
    "scene": ((), (*_ZONES, "profile", "phase", "frames", "exposures")),
    "grey_levels": ((), (*_ZONES, "frames")),
    "alignment": ((*_ZONES, "marks", "spread", "size"), ("profile", "phase", "map", "frames")),
}
_MM = quantity("mm", positive=True, many=True)
_CELLS = whole(1, 65536, optional=True, many=True)
_SIZE = quantity("mm", positive=True, optional=True)


@dataclass(frozen=True)
class PlanRequest:
    """Captures requested of a plan.

    - `betas`: β of the Fresnel zone apertures, two or more for method_b, else one; `width`,
      `profile`, `phase`: width, profile and phase of all of them.
    - `distances`: mask-sensor distances (method_a) or those of
      what the stage carries (psf_stack; the stage of a virtual rig carries the sensor).
    - `cells`: rows and columns of cells on a monitor.
    - `order`, `display`: order and display of the Hadamard patterns.
    - `marks`: rows and columns of marks on a square of the side `spread` about a monitor's middle,
      each with the diameter `size`; `map`: map that is fitted to them, a "homography" if it is
      tilted.
    - `frames`: frames of each picture, mark or level, whose mean counts; of each exposure of a
      scene.
    - `mosaic`: masks side by side, all in one exposure; their `pitch` is whole display pixels.
    - `exposures`: exposures of a scene, in place of the camera's; several are merged to one linear
      image.
    - `dark_frames`: in all; they are spread over the plan. Of a scene, for each exposure.

    **Errors**: FieldError for what the kind lacks or does not take.
    """

    kind: Annotated[PlanKind, choice(get_args(PlanKind))]
    betas: Annotated[tuple[float, ...], quantity("rad/mm^2", positive=True, many=True)] = ()
    width: Annotated[float | None, _SIZE] = None
    profile: Annotated[Profile, choice(PROFILES)] = "cosine"
    phase: Annotated[float, quantity("rad")] = 0.0
    distances: Annotated[tuple[float, ...], _MM] = ()
    cells: Annotated[tuple[int, int] | None, _CELLS] = None
    order: Annotated[Order, choice(get_args(Order))] = "sequency"
    display: Annotated[Display, choice(get_args(Display))] = "complementary"
    marks: Annotated[tuple[int, int] | None, whole(1, 100, optional=True, many=True)] = None
    spread: Annotated[float | None, _SIZE] = None
    size: Annotated[float | None, _SIZE] = None
    map: Annotated[MapKind, choice(get_args(MapKind))] = "similarity"
    frames: Annotated[int, whole(1, 1000)] = 1
    exposures: Annotated[tuple[float, ...], quantity("s", positive=True, many=True)] = ()
    dark_frames: Annotated[int, DARK_FRAMES] = 0
    mosaic: Layout | None = None

    def __post_init__(self):
        check_fields(self)
        # A resolved file names the defaults, too.
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        needed, also = _NUMBERS[self.kind]
        allowed = (*needed, *also)
        for key in needed:
            if not getattr(self, key):
                raise FieldError(f"a plan of kind {self.kind} needs it", key)
        for key in sorted(given.difference((*allowed, "kind", "dark_frames"))):
            raise FieldError(f"a plan of kind {self.kind} takes {', '.join(allowed)}; drop it", key)
        if self.kind == "method_b" and len(self.betas) < 2:
            raise FieldError("method_b compares two β or more; give another", "betas")
        if self.kind != "method_b" and len(self.betas) > 1:
            raise FieldError(f"a plan of kind {self.kind} has one β; give one", "betas")
        if self.mosaic is not None:
            masks = 4 if self.kind == "fringe_scan" else 2 * len(self.betas)
            if masks != self.mosaic.rows * self.mosaic.columns or self.mosaic.pitch is None:
                fault = f"{masks} masks are shown; give as many rows × columns, and their pitch"
                raise FieldError(fault, "mosaic")
        for key in ("frames", "dark_frames"):
            if len(self.exposures) > 1 and getattr(self, key) < 2:
                raise FieldError("exposures are weighed by the noise of each; give 2 or more", key)
        for key in ("betas", "distances", "exposures"):
            if len(set(getattr(self, key))) < len(getattr(self, key)):
                raise FieldError("an entry stands twice; give each once", key)
        if self.kind == "hadamard":
            try:
                _ = self.series
            except ValueError as error:
                raise FieldError(str(error), "cells") from None

    def by_cells(self, matrix: bool, optics: bool) -> bool:
        """Whether the camera is one of cells, with a matrix."""
        return matrix or self.kind == "hadamard" or (self.kind == "pictures" and not optics)

    def rules(
        self,
        given: set[str],
        camera: CameraSettings,
        pitch: float | None,
        targets: int,
        simulated: bool,
    ) -> Iterator[tuple[Any, ...]]:
        """Whether each rule of a file is broken, what is wrong then, and where.

        - `given`: names of the sections that the file has, and of the keys of its optics. `pitch`:
          pixel pitch of its display.
        """
        name, kind = self.kind, f"a plan of kind {self.kind}"
        named = "optics", "matrix", "alignment", "mask"
        optics, matrix, aligned, mask = (key in given for key in named)
        by_cells, pictures = self.by_cells(matrix, optics), name == "pictures"
        moves = name in ("method_a", "psf_stack") and "stage" not in given
        yield moves, f"{kind} moves a stage; give one", "stage"
        unknown = pitch is None and (name != "scene" or simulated)
        yield unknown, f"{kind} is shown on pixels; give it", "display", "pitch"
        maskless = optics and self.width is None and not by_cells and not mask
        yield maskless, "optics need betas and width of the mask; give them", "plan", "width"
        fault = f"is of a {' or '.join(SHOWN)} with optics and without betas and width; drop it"
        yield mask and (name not in SHOWN or not optics or self.betas or self.width), fault, "mask"
        unfit = by_cells == optics and (by_cells or simulated or name not in ANYTHING)
        yield unfit, f"{kind} {'takes no' if by_cells else 'needs'} optics", "optics"
        yield pictures and not (optics or matrix), f"{kind} needs it", "matrix"
        yield matrix and not pictures and name != "scene", f"{kind} takes none; drop it", "matrix"
        coloured = camera.bayer is not None
        grey = f"{kind}{' with a matrix' if matrix else ''} takes one colour; give a Mono format"
        yield coloured and (matrix or name in MONITOR), grey, "camera", "pixel_format"
        whole = self.mosaic is not None and camera.region is not None
        yield whole, "a mosaic has parts on the whole sensor; drop it", "camera", "region"
        striped = self.mosaic is not None and coloured
        yield striped, "a mosaic takes one colour; give a Mono format", "camera", "pixel_format"
        light = "a wavelength and no colours"
        light = "colours: [red, green, blue] and no wavelength" if coloured else light
        for key, wanted in (("colours", coloured), ("wavelength", not coloured)):
            wrong = optics and (key in given) != wanted
            yield wrong, f"{camera.pixel_format} takes {light}", "optics", key
        yield pictures and optics and not aligned, f"{kind} with optics needs it", "alignment"
        yield aligned and not (pictures and optics), f"{kind} takes none; drop it", "alignment"
        yield pictures and not targets, f"{kind} needs them; give one", "targets"
        yield matrix and "methods" not in given, f"{kind} needs them; give one", "methods"
        unused = "methods" in given and not matrix
        yield unused, f"{kind} has 'reconstruction'; drop them", "methods"
        several = targets > 1 and not pictures
        yield several, f"{kind} has one; drop the others", "targets"

    @property
    def series(self) -> HadamardSeries:
        """Series of patterns of a plan of kind hadamard."""
        assert self.cells is not None
        return HadamardSeries(self.cells, self.order, self.display, self.dark_frames)

    def plan(
        self,
        settings: CameraSettings,
        *,
        stage_zero: float = 0.0,
        shown: Mapping[str, np.ndarray] | None = None,
        mask: Pattern = WHITE,
    ) -> AcquisitionPlan:
        """The steps.

        - `stage_zero`: distance at the stage's position 0, mm.
        - `shown`: levels of the pictures on the cells, uint8, by name.
        - `mask`: mask of plans without `betas`.
        """
        dark = {"dark_frames": self.dark_frames}
        if self.kind == "alignment":
            assert self.marks and self.spread and self.size
            grid = self.marks, self.spread, self.size
            return plans.alignment(*grid, settings, frames=self.frames, **dark)
        if self.kind == "hadamard":
            return plans.hadamard(self.series, settings)
        if self.kind == "pictures":
            return plans.pictures(shown or {}, settings, frames=self.frames, **dark)
        if self.kind == "grey_levels":
            return plans.grey_levels(settings, frames=self.frames)
        if self.betas:
            form = {"phase": self.phase, "profile": self.profile}
            mask = plans.zone_plate(self.betas[0], self.width or 0.0, **form)
        if self.kind == "scene":
            given = {"exposures": self.exposures, "frames": self.frames, **dark}
            return plans.scene(mask, settings, **given)
        if self.kind in ("method_b", "fringe_scan"):
            if self.kind == "method_b":
                plan = plans.method_b(mask, self.betas, settings, **dark)
            else:
                plan = plans.fringe_scan(mask, settings, **dark)
            if self.mosaic is None:
                return plan
            masks = [plan.pattern(step) for step in plan.steps if not step.dark]
            rows, columns, pitch = self.mosaic.rows, self.mosaic.columns, self.mosaic.pitch or 0.0
            return plans.mosaic(masks, rows, columns, pitch, settings, **dark)
        of_distances = plans.method_a if self.kind == "method_a" else plans.psf_stack
        return of_distances(mask, self.distances, settings, stage_zero=stage_zero, **dark)
