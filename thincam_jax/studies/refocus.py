"""A scene with depth, captured once and focused afterwards.

A mask's shadow grows with 1 + d/t, so that one set of captures holds the distance t of what it
shows: it is reconstructed at many distances, and each object is where its image is sharpest (thesis
section 3.5.2).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import FieldError, check_fields, choice, quantity, whole
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import resize
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.reconstruction.depth.find import (
    MEASURES,
    DepthMap,
    FocusCurves,
    FocusPeak,
    Measure,
    all_in_focus,
    depth_map,
    find_distances,
    object_regions,
)
from thincam_jax.reconstruction.depth.refocus import (
    RefocusSweep,
    axial_resolution,
    refocus_distances,
)
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import (
    Capture,
    expose,
    noise_free,
    reconstructor,
    rounded,
    sample,
    stacked,
)
from thincam_jax.studies.study import Method, Study, Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARGIN = 1.15  # the field over what the objects cover


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A picture (y, x) or (y, x, channel) that stands at a distance, on a dark ground.

    - `distance`, `width`: mm; `x`, `y`: place of its middle, mm.

    Colours are averaged.
    """

    name: str
    picture: Float[np.ndarray, "y x *channel"]
    distance: Annotated[float, quantity("mm", positive=True)]
    width: Annotated[float, quantity("mm", positive=True)]
    x: Annotated[float, quantity("mm")] = 0.0
    y: Annotated[float, quantity("mm")] = 0.0

    def __post_init__(self):
        check_fields(self)


@dataclass(frozen=True)
class PlacedTarget(Target):
    """An object whose middle is at (x, y), mm, on a dark plane of its own centred on the axis."""

    x: float = 0.0
    y: float = 0.0

    @property
    def height(self) -> float:
        """Height of the object, mm: its plane reaches as far to the other side of the axis."""
        return float(self.plane.height) - 2 * abs(self.y)


@dataclass(frozen=True)
class FocusRange:
    """The distances of a sweep of the focus, and its measure of sharpness.

    - `method`: by name, that the sweep reconstructs with.
    - `nearest`, `farthest`: mm; `count`: number of distances, evenly spaced in 1/t.
    - `measure`, `smoothing`: measure of sharpness, see `focus_measure`; `window`: window of the
      depth map.
    """

    method: str
    nearest: Annotated[float, quantity("mm", positive=True)]
    farthest: Annotated[float, quantity("mm", positive=True)]
    count: Annotated[int, whole(5, 200)] = 25
    measure: Annotated[Measure, choice(MEASURES)] = "laplacian_variance"
    smoothing: Annotated[float, quantity("pixels", least=0.0, most=50.0)] = 1.0
    window: Annotated[float, quantity("pixels", least=0.5, most=100.0)] = 6.0

    def __post_init__(self):
        check_fields(self)
        if not self.nearest < self.farthest:
            raise FieldError("nearest is not below farthest; swap them", "nearest")

    @property
    def distances(self) -> list[float]:
        """Distances of the sweep, mm."""
        return np.asarray(refocus_distances(self.nearest, self.farthest, self.count)).tolist()


@dataclass(frozen=True, eq=False)
class RefocusStudy:
    """Cameras and methods before several objects, and a sweep of the focus.

    - `study`: its targets are the objects, all in one scene; see `of_objects`.

    ```python
    import thincam_jax as tc
    from thincam_jax.imaging.targets import siemens_star
    from thincam_jax.studies import Method, Study
    from thincam_jax.studies.refocus import FocusRange, RefocusStudy, SceneObject
    from thincam_jax.units import nm, um

    exposures = tc.Exposures(80.0, 5.0, wavelength=500 * nm, width=1.92).fringe_scanned()
    cameras = Study(
        mask=tc.FresnelZoneAperture(80.0, width=1.92),
        sensor=tc.Sensor(shape=(96, 112), pitch=20 * um),
        methods=(Method("wiener", exposures, tc.Wiener(), "fringe_scanning"),),
        noise=tc.GaussianNoise(snr_db=30.0, signal_power="without_mean"),
        model="geometric",
    )
    star = siemens_star((64, 64))
    near = SceneObject("near", star, distance=20.0, width=2.4, x=-1.9)
    far = SceneObject("far", star, distance=45.0, width=5.4, x=4.0)
    sweep = FocusRange("wiener", nearest=15.0, farthest=90.0, count=9)
    result = RefocusStudy.of_objects(cameras, [near, far], sweep).run()
    print(result.objects["near"].found_mm)
    ```
    """

    study: Study
    sweep: FocusRange

    @classmethod
    def of_objects(
        cls, study: Study, objects: Sequence[SceneObject], sweep: FocusRange
    ) -> "RefocusStudy":
        """The study with objects in place of its targets.

        **Errors**: ValueError for an object that covers too few pixels.
        """
        targets = tuple(place(study, number, one) for number, one in enumerate(objects))
        return cls(replace(study, targets=targets), sweep)

    @property
    def objects(self) -> tuple[PlacedTarget, ...]:
        """Contents of the scene."""
        return tuple(one for one in self.study.targets if isinstance(one, PlacedTarget))

    @property
    def sweep_method(self) -> Method:
        """The method that the sweep reconstructs with."""
        return next(m for m in self.study.methods if m.name == self.sweep.method)

    def capture(self, exposure: Exposure) -> Capture:
        """One capture of all objects together, (y, x)."""
        planes = [target.plane for target in self.study.targets]
        return expose(self.study, exposure, noise_free(self.study, exposure, *planes), 0)

    def field_shape(self, method: Method) -> tuple[int, int]:
        """Pixels of a reconstruction: all directions of objects about the axis, and a margin."""
        scale = _MARGIN * method.distance / self.study.pitch
        planes = [target.plane for target in self.study.targets]
        extents = [(float(p.height), float(p.width)) for p in planes]
        angles = np.asarray(extents) / np.asarray([[float(p.distance)] for p in planes])
        rows, columns = (math.ceil(scale * angle) for angle in angles.max(axis=0))
        # The same parity for all: rows are then rows of one grid of directions.
        return rows + rows % 2, columns + columns % 2

    def focus(
        self, method: Method, captures: Mapping[Exposure, Capture], distance: float
    ) -> Reconstruction:
        """A method's reconstruction (y, x) focused on one distance, mm."""
        images, variances = stacked([captures[exposure] for exposure in method.exposures])
        solve = reconstructor(self.study, method, self.field_shape(method), distance)
        result = solve(images[:, None], variances[:, None])
        return jax.tree.map(lambda leaf: leaf[0] if leaf.ndim == 3 else leaf, result)

    def object_box(self, method: Method, placed: PlacedTarget) -> tuple[slice, slice]:
        """Rows and columns of an object in a method's reconstructions, whatever their focus."""
        shape, scale = self.field_shape(method), _pixels_per_mm(self.study, method, placed)
        places, sizes = (placed.y, placed.x), (placed.height, placed.width)
        sides = []
        for middle, size, count in zip(places, sizes, shape, strict=True):
            centre = (count - 1) / 2 + middle * scale
            first = max(0, round(centre - size * scale / 2 + 0.5))
            sides.append(slice(first, min(count, round(centre + size * scale / 2 + 0.5))))
        return sides[0], sides[1]

    def run(self, progress: Progress | None = None) -> "RefocusResult":
        """Capture, sweep the focus, find the objects, and focus every method on each."""
        run = RefocusRun(self)
        carry_out(run.work, progress)
        return run.result


def place(study: Study, number: int, given: SceneObject) -> PlacedTarget:
    """An object as a target of a study, with two pixels to one of the finest reconstruction.

    **Errors**: ValueError where it covers too few pixels to be scored.
    """
    picture = np.atleast_3d(given.picture).astype(np.float32)
    picture = picture.astype(np.float64).mean(axis=-1)
    scales = [_pixels_per_mm(study, method, given) for method in study.methods]
    covered = min(round(given.width * scale) for scale in scales)
    if covered < 2 * SSIM_WINDOW:
        raise ValueError(
            f"covers {covered} pixels of a reconstruction; give it a larger width or the sensor a "
            f"smaller pitch, for at least {2 * SSIM_WINDOW}"
        )
    columns = max(8, round(2 * given.width * max(scales)))
    rows = max(8, round(columns * picture.shape[0] / picture.shape[1]))
    pitch = given.width / columns
    picture = resize(picture, (rows, columns))
    right, down = round(given.x / pitch), round(given.y / pitch)
    canvas = np.zeros((rows + 2 * abs(down), columns + 2 * abs(right)), np.float32)
    top, left = down + abs(down), right + abs(right)
    canvas[top : top + rows, left : left + columns] = picture
    plane = ImagePlane(canvas, given.distance, canvas.shape[1] * pitch)
    numbers = (given.distance, given.width, plane, given.x, given.y)
    return PlacedTarget(number, given.name, "file", *numbers)


def _pixels_per_mm(study: Study, method: Method, placed: SceneObject | Target) -> float:
    """Pixels of a reconstruction for each mm on an object."""
    return method.distance / placed.distance / study.pitch


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """Regions of a sweep, their focus curves, and which region each object is (None: none)."""

    regions: np.ndarray
    curves: FocusCurves | None
    region_of: dict[str, int | None]

    def peak(self, name: str) -> FocusPeak | None:
        """The focus of an object."""
        region = self.region_of[name]
        return None if region is None or self.curves is None else self.curves.distance_of(region)

    def curve(self, name: str) -> np.ndarray | None:
        """The focus measure of an object over the distances of the sweep."""
        region = self.region_of[name]
        if region is None or self.curves is None:
            return None
        return self.curves.curves[self.curves.labels.index(region)]


def find_objects(refocusing: RefocusStudy, sweep: RefocusSweep) -> FoundObjects:
    """Regions of the picture and their distances; objects are named by where they were placed."""
    regions, asked = object_regions(sweep), refocusing.sweep
    method = refocusing.sweep_method
    boxes = {one.name: refocusing.object_box(method, one) for one in refocusing.objects}
    if not regions.any():
        return FoundObjects(regions, None, dict.fromkeys(boxes))
    curves = find_distances(
        sweep, measure=asked.measure, smoothing=asked.smoothing, regions=regions
    )
    found = {name: _covering(regions[box]) for name, box in boxes.items()}
    return FoundObjects(regions, curves, found)


def _covering(part: np.ndarray) -> int | None:
    """The region that covers most of an object's box, if it covers a quarter of it."""
    counts = np.bincount(part.ravel())
    counts[0] = 0  # the ground
    most = int(np.argmax(counts))
    return most if counts[most] >= part.size / 4 else None


@dataclass(frozen=True)
class ObjectScores:
    """The distance of an object as placed and as found; None where it was not found."""

    distance_mm: float
    found_mm: float | None
    error_percent: float | None
    focus_contrast: float | None
    axial_resolution_mm: float


@dataclass(frozen=True)
class FocusScores:
    """A method focused on one distance: PSNR of every object within its box, dB, by name.

    After a gain and an offset of its own; None where exact. `iterations`: None in closed form.
    """

    psnr_db: dict[str, float | None]
    status: str
    iterations: int | None


@dataclass(frozen=True)
class RefocusedMethod:
    """The captures of a method and its scores, by the distance that it is focused on, mm."""

    captures: int
    focused_on_mm: dict[str, FocusScores]


@dataclass(frozen=True, eq=False)
class RefocusResult:
    """The sweep, the objects found in it, and the methods focused on each object.

    - `depth`, `sharp`: depth map, and the picture (y, x) that is sharp everywhere.
    - `images`: by the method's name and the distance, mm.
    """

    refocusing: RefocusStudy
    sweep: RefocusSweep
    found: FoundObjects
    depth: DepthMap
    sharp: Float[np.ndarray, "y x"]
    objects: dict[str, ObjectScores]
    methods: dict[str, RefocusedMethod]
    images: dict[tuple[str, float], np.ndarray]

    def table(self) -> Table:
        """Distances at which objects were placed and found."""
        rows = [
            (name, f"{o.distance_mm:g}", o.found_mm, o.error_percent, o.axial_resolution_mm)
            for name, o in self.objects.items()
        ]
        headings = ("object", "placed at\nmm", "found at\nmm", "error\n%", "depth of focus\nmm")
        return Table(headings, rows, (0, 1, 1, 0))

    def methods_table(self) -> Table:
        """PSNR of every object by every method, focused on each of them."""
        rows = []
        for name, method in self.methods.items():
            for distance, one in method.focused_on_mm.items():
                psnr_db = (one.psnr_db[placed] for placed in self.objects)
                count = None if one.iterations is None else f"{one.iterations} ({one.status})"
                rows.append((name, method.captures, distance, *psnr_db, count))
        each = (f"{name} at {o.distance_mm:g} mm\nPSNR dB" for name, o in self.objects.items())
        headings = ("method", "captures", "focused on\nmm", *each, "iterations")
        return Table(headings, rows, (1,) * (len(headings) - 1))

    def findings(self) -> list[str]:
        """Main results in sentences."""
        sentences = []
        for name, found in self.objects.items():
            if found.found_mm is None:
                sentences.append(f"{name}, placed at {found.distance_mm:g} mm, was not found.")
                continue
            sentences.append(
                f"{name}, placed at {found.distance_mm:g} mm, is sharpest at "
                f"{found.found_mm:.1f} mm ({found.error_percent:+.1f} %)."
            )
        spans = [found.axial_resolution_mm for found in self.objects.values()]
        distances = sorted(target.distance for target in self.refocusing.study.targets)
        if len(distances) > 1:
            gap = min(b - a for a, b in zip(distances, distances[1:], strict=False))
            sentences.append(
                f"The objects stand {gap:g} mm apart or more; the depth of focus, "
                f"π t (t+d) / (β d R²), is {min(spans):.0f} to {max(spans):.0f} mm."
            )
        return sentences

    def plot(self) -> "Figure":
        """Every method focused on every object; below each, the objects enlarged."""
        from thincam_jax.plot.frame import new_figure
        from thincam_jax.plot.refocus import draw_methods

        return draw_methods(self, new_figure(1.0, 1.0))


def refocus_metrics(result: RefocusResult) -> dict[str, Any]:
    """Objects, focus curves and methods as numbers."""
    sweep, asked = result.sweep, result.refocusing.sweep
    found = {name: result.found.curve(name) for name in result.objects}
    focused = {
        "method": asked.method,
        "measure": asked.measure,
        "distances_mm": [round(float(t), 4) for t in sweep.distances],
        "slope_per_pixel": float(f"{float(np.asarray(sweep.slope)):.6g}"),
        "curves": {n: [float(f"{v:.6g}") for v in c] for n, c in found.items() if c is not None},
    }
    objects = {name: asdict(one) for name, one in result.objects.items()}
    methods = {name: asdict(one) for name, one in result.methods.items()}
    return {"objects": objects, "sweep": focused, "methods": methods}


class RefocusRun:
    """A refocusing study step by step: `work` fills what `result` holds."""

    def __init__(self, refocusing: RefocusStudy):
        study, self.refocusing = refocusing.study, refocusing
        self.captures: dict[Exposure, Capture] = {}
        self.swept: list[Reconstruction] = []
        self.images: dict[tuple[str, float], np.ndarray] = {}
        self.methods = {m.name: RefocusedMethod(len(m.exposures), {}) for m in study.methods}
        self.work: list[Step] = []
        for count, exposure in enumerate(study.exposures, 1):
            self._add(f"capture {count}", self._capture, exposure)
        for count, distance in enumerate(refocusing.sweep.distances, 1):
            self._add(f"{refocusing.sweep.method}: distance {count}", self._sweep, distance)
        for method in study.methods:
            for distance in (target.distance for target in study.targets):
                self._add(f"{method.name}: {distance:g} mm", self._focus, method, distance)

    def _add(self, text: str, do: Any, *arguments: Any) -> None:
        self.work.append(Step(text, partial(do, *arguments)))

    def _capture(self, exposure: Exposure) -> None:
        self.captures[exposure] = self.refocusing.capture(exposure)

    def _sweep(self, distance: float) -> None:
        method = self.refocusing.sweep_method
        self.swept.append(self.refocusing.focus(method, self.captures, distance))

    def _focus(self, method: Method, distance: float) -> None:
        found = self.refocusing.focus(method, self.captures, distance)
        self.images[method.name, distance] = np.asarray(found.image)
        self.methods[method.name].focused_on_mm[f"{distance:g}"] = FocusScores(
            psnr_of_objects(self.refocusing, method, found), found.status, found.iterations or None
        )

    @property
    def result(self) -> RefocusResult:
        """All of it, at the end."""
        refocusing, asked = self.refocusing, self.refocusing.sweep
        images, distances = jnp.stack([one.image for one in self.swept]), asked.distances
        # p·t/d of any image over its t.
        slope = jnp.reshape(jnp.asarray(self.swept[-1].pitch, images.dtype), ()) / distances[-1]
        solver = refocusing.sweep_method.solver.name
        sweep = RefocusSweep(images, jnp.asarray(distances, images.dtype), slope, solver)
        found = find_objects(refocusing, sweep)
        depth = depth_map(
            sweep, measure=asked.measure, smoothing=asked.smoothing, window=asked.window
        )
        return RefocusResult(
            refocusing,
            sweep,
            found,
            depth,
            np.asarray(all_in_focus(sweep, depth)),
            {one.name: object_scores(refocusing, found, one) for one in refocusing.objects},
            self.methods,
            self.images,
        )


def psnr_of_objects(
    refocusing: RefocusStudy, method: Method, reconstruction: Reconstruction
) -> dict[str, float | None]:
    """PSNR of every object within its box, dB, after a gain and an offset of its own."""
    image, scores = np.asarray(reconstruction.image, dtype=float), {}
    for placed in refocusing.objects:
        box = refocusing.object_box(method, placed)
        grid = Grid(image.shape, 1 / _pixels_per_mm(refocusing.study, method, placed))
        truth = np.asarray(sample(placed.plane, grid), dtype=float)
        scores[placed.name] = rounded(psnr(image[box], truth[box]))
    return scores


def object_scores(
    refocusing: RefocusStudy, found: FoundObjects, placed: PlacedTarget
) -> ObjectScores:
    """The distance of an object as placed and as found, beside the depth of focus."""
    peak, distance = found.peak(placed.name), placed.distance
    at = None if peak is None or peak.at_end else peak.distance
    cameras = (refocusing.study.camera(one) for one in refocusing.sweep_method.exposures)
    return ObjectScores(
        round(distance, 4),
        None if at is None else round(at, 2),
        None if at is None else round(100 * (at / distance - 1), 2),
        None if peak is None else round(peak.contrast, 4),
        round(
            min(float(axial_resolution(camera, object_distance=distance)) for camera in cameras), 2
        ),
    )
