"""Where a rig's sensor stood for each shot, by what the images of the single shots show.

A stage moved by hand stands some µm beside what its scale reads, along the axis and across it. The
image of one shot scales with its mask-sensor distance d and moves with the sensor. So
`estimate_registration` against the first shot's image finds both, from a scale s and a shift of a
pixels p: d = s·d_ref, and the mask's middle at c = −a·p/M beside the sensor's, M = 1 + d/t, since
images are turned by 180°. The first shot is taken to stand where it reads.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from thincam_jax._core.table import Table
from thincam_jax.hardware.studies.images import frame_solver, square_field
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.measured.bayer import Pattern
from thincam_jax.measured.calibration.registration import estimate_registration
from thincam_jax.reconstruction.wiener import Wiener
from thincam_jax.studies.study import Method, Study

_LEAST = 32  # pixels a side of an image that is registered
_SIGMAS = 3.0  # standard errors that a difference has to exceed
_SEARCH = 0.05  # part of a distance within which a shot may stand elsewhere
_VAGUE = 0.005  # part of a distance by which it is uncertain where images show no scene
_PIXEL = 0.05  # differences of fewer pixels are left as they are


@dataclass(frozen=True)
class ShotPlace:
    """Place of a shot's mask and sensor to each other, mm.

    - `read`: distance as its stage reads it. `distance`, `centre`: distance and the mask's middle
      (y, x) beside the sensor's, as they count for the reconstruction.
    - `distance_error`, `centre_error`: standard errors of those that were found.
    - `status`: "reference"; "moved", found elsewhere than read; "as read", found there; else the
      status of the registration, whose place does not count.
    """

    read: float
    distance: float
    centre: tuple[float, float] = (0.0, 0.0)
    distance_error: float = 0.0
    centre_error: float = 0.0
    status: str = "reference"


@dataclass(frozen=True)
class ShotPlaces:
    """Places of the shots of a study's methods, the first shot's the reference."""

    shots: tuple[ShotPlace, ...]

    def __str__(self) -> str:
        moved = [one for one in self.shots if one.status == "moved"]
        lost = [one for one in self.shots if one.status not in ("moved", "as read", "reference")]
        texts = []
        if moved:
            along = 1000 * max(abs(one.distance - one.read) for one in moved)
            across = 1000 * max(max(map(abs, one.centre)) for one in moved)
            texts.append(
                f"{len(moved)} of {len(self.shots)} shots stood elsewhere than read, by up to "
                f"{along:.0f} µm along the axis and {across:.0f} µm across it: taken from there"
            )
        if lost:
            texts.append(f"{len(lost)} could not be registered, and stand as read")
        return "; ".join(texts or ["all shots stand where they are read"]) + "."

    def table(self) -> Table:
        """Read and found places, mm and µm."""
        rows = [
            (f"{one.read:.4f}", one.distance, 1e3 * one.distance_error,
             *(1e3 * c for c in one.centre), 1e3 * one.centre_error, one.status)
            for one in self.shots
        ]  # fmt: skip
        heads = "read (mm)", "found (mm)", "± (µm)", "y (µm)", "x (µm)", "± (µm)", "status"
        return Table(heads, rows, digits=(4, 1, 1, 1, 1))


def register_shots(
    study: Study,
    frames: Float[np.ndarray, "capture y x"],
    width: float,
    bayer: Pattern | None = None,
) -> ShotPlaces:
    """Places of each shot of a study, by frames (capture, y, x) of its exposures.

    - `width`: width of the square object that the images cover, mm.
    - `bayer`: pattern of the frames, see `frame_solver`.

    A place counts where it differs from the read one by more than 3 standard errors and moves the
    image's edge by more than 0.05 pixels: along the axis, down or across. Shots stand as read whose
    images have fewer than 32 pixels a side, leave the distance open by more than 0.5 %, or say that
    it is off by more than 5 %.
    """
    phases, shots = study.methods[0].phases, study.methods[0].shots
    first = shots[0]
    side, _ = square_field(study, width * first.distance / study.methods[0].distance)
    places = [ShotPlace(first.distance, first.distance)]
    if side < _LEAST:
        return ShotPlaces((*places, *(_unregistered(one, "too few pixels") for one in shots[1:])))
    images = []
    for number, shot in enumerate(shots):
        taken = slice(number * phases, (number + 1) * phases)
        methods = [_alone(method, taken, number) for method in study.methods]
        one = replace(study, methods=tuple(methods))
        across = side * study.pitch * study.object_distance / shot.distance
        found = frame_solver(one, across, bayer=bayer)(frames[taken])
        images.append(np.asarray(found.image, float).reshape(-1, side, side).mean(axis=0))
    for shot, image in zip(shots[1:], images[1:], strict=True):
        places.append(_place(study, first, shot, image, images[0]))
    return ShotPlaces(tuple(places))


def _unregistered(shot: Exposure, status: str) -> ShotPlace:
    return ShotPlace(shot.distance, shot.distance, status=status)


def _place(study: Study, first: Exposure, shot: Exposure, image, reference) -> ShotPlace:
    ratio = shot.distance / first.distance
    found = estimate_registration(image, reference, scale=ratio, search=_SEARCH)
    stretch, error = float(found.scale) / ratio - 1, float(found.scale_error) / ratio
    if found.status != "ok" or abs(stretch) > _SEARCH or error > _VAGUE:
        return _unregistered(shot, "poor_fit" if found.status == "ok" else found.status)
    edge, millimetres = len(image) / 2, study.pitch / (1 + shot.distance / study.object_distance)
    pixels = np.array([edge * stretch, *found.shift])
    errors = np.array([edge * error, *found.shift_error])
    if np.all(np.abs(pixels) <= np.maximum(_PIXEL, _SIGMAS * errors)):
        return _unregistered(shot, "as read")
    return ShotPlace(
        shot.distance,
        shot.distance * (1 + stretch),
        (-millimetres * float(pixels[1]), -millimetres * float(pixels[2])),
        shot.distance * error,
        millimetres * float(errors[1:].max()),
        "moved",
    )


def _alone(method: Method, taken: slice, number: int) -> Method:
    """The method of one shot, by a Wiener filter."""
    rows = tuple(method.exposures)[taken]
    name, alone = f"{method.name}, shot {number}", Exposures.of(rows)
    return replace(method, name=name, exposures=alone, solver=Wiener())


def standing_at(study: Study, places: ShotPlaces) -> Study:
    """The study with its shots at their places; others keep those of the mask."""
    methods = []
    for method in study.methods:
        each = [place for place in places.shots for _ in range(method.phases)]
        is_aside = np.any([place.centre for place in each])
        rows = [
            replace(one, distance=place.distance, centre=place.centre if is_aside else None)
            for one, place in zip(method.exposures, each, strict=True)
        ]
        methods.append(replace(method, exposures=Exposures.of(rows)))
    return replace(study, methods=tuple(methods))


def read_distances(distance: float, positions: Sequence[float], phases: int) -> tuple[float, ...]:
    """Mean mask-sensor distance of each shot, mm, from the positions of its captures."""
    means = np.reshape(positions, (-1, phases)).mean(axis=1)
    return tuple(round(float(one), 6) for one in distance + means)
