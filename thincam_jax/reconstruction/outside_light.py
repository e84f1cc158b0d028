"""Light from outside of the field, found in what an image leaves of the captures.

A field that is too small explains it by light at its border, and not all of it: the smooth residual
stays above the noise (`smooth_misfit`). Then pixels four times as wide, begun with the image, show
in the whole field that the sensor sees how much light moves out, and how far.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import same_parity
from thincam_jax.imaging.operators.crop_convolution import middle_corner, place
from thincam_jax.reconstruction.coarse import coarsened
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.other_psf import without_size
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.problem import InverseProblem
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.result import Reconstruction, saying
from thincam_jax.reconstruction.smooth_misfit import misfit_of
from thincam_jax.reconstruction.splittings import admm_method

# Smooth residual over that of the noise from which on light may come from outside, the most of it
# that stays if it does, and the most after that: 0.8 to 4.2, of 10 % of shading 13 to 33.
_SUSPECTED, _STAYS, _LEFT = 1.5, 0.7, 8.0
# Part of the field's brightness that is an object, not haze that explains shading; the least share
# of the light that counts, and the share that may stay outside of the field named.
_BRIGHT, _COUNTS, _BEYOND = 0.2, 0.05, 0.01
_HALVED, _SCHEDULE = 2, Schedule(50, 3e-3, adapt_until=25, settled=3e-2)


@dataclass(frozen=True)
class OutsideLight:
    """Share of the light that comes from outside of a field, and the pixels that hold it."""

    share: float
    field_shape: tuple[int, int]

    def __str__(self) -> str:
        return f"{self._comes} of the field: give field_shape={self.field_shape}"

    @property
    def taken(self) -> str:
        """Sentence where the image has that field by default."""
        return f"{self._comes} of the sensor's field: the image has field_shape={self.field_shape}"

    @property
    def _comes(self) -> str:
        return f"{100 * self.share:.0f} % of the light comes from outside"


def outside_light(
    recording: Recording, problem: InverseProblem, image: Image, synthesis: np.ndarray | None
) -> OutsideLight | None:
    """Light from outside of the field of cameras that an image leaves; None for none."""
    model = recording.imaging_model
    if not isinstance(model, Cameras) or model.over_field or problem.image_shape[-3] > 1:
        return None
    if model.whole_scene:
        return None
    misfit, field = misfit_of(problem, image), problem.field_shape
    if misfit is None or max(misfit.smooth) < _SUSPECTED:
        return None
    whole = max(model.seen_field[0], field[0]), max(model.seen_field[1], field[1])
    try:
        wide = with_field(recording, whole).problem(
            tau=problem.tau, nonnegative=bool(np.min(np.asarray(image)) >= 0), synthesis=synthesis
        )
    except MemoryError:
        return None
    start = place(image, middle_corner(field, wide.field_shape), wide.field_shape)
    wide, start, size = coarsened(wide, start, _HALVED)
    method = in_parallel(wide, admm_method)
    found = iterate(method, start, _SCHEDULE).image
    before, after = (misfit_of(wide, one) for one in (start, found))
    if before is None or after is None:
        return None
    if max(after.smooth) > min(_LEFT, _STAYS * max(before.smooth)):
        return None
    light = np.abs(np.asarray(found)).reshape(-1, *found.shape[-2:]).sum(axis=0)
    rows, columns = (
        slice((n - m) // 2, (n + m) // 2)
        for n, m in zip(light.shape, (-(-f // size) for f in field), strict=True)
    )
    inside = light[rows, columns]
    light[light < _BRIGHT * np.sum(inside**2) / max(inside.sum(), np.finfo(float).tiny)] = 0
    share = float(1 - light[rows, columns].sum() / light.sum())
    if not share >= _COUNTS:  # NaN of a black image, too
        return None
    height, width = (
        _held(light.sum(axis=1 - axis), size, field[axis], whole[axis]) for axis in (0, 1)
    )
    return OutsideLight(share, same_parity((height, width), model.cameras[0].sensor.shape))


def reaching_beyond(
    solve: Callable[[Recording], Reconstruction],
    recording: Recording,
    problem: InverseProblem,
    image: Image,
    result: Reconstruction,
    synthesis: np.ndarray | None = None,
) -> Reconstruction:
    """The result, with the sentence on light from outside of its field.

    Where no field is given, the recording is solved again in the field that holds the light.

    - `image`: image of the `problem`, by which the residual is judged.
    """
    outside = outside_light(recording, problem, image, synthesis)
    if outside is None:
        return result
    if recording.imaging_model.pixels is not None:  # type: ignore[union-attr]
        return saying(result, without_size(result.reason), str(outside))
    again = solve(with_field(recording, outside.field_shape))
    return saying(again, outside.taken, again.reason)


def covering(recording: Recording, start: Float[Array, "..."] | None) -> Recording:
    """A recording whose field holds the start image; a field that is given stays."""
    model = recording.imaging_model
    if start is None:
        return recording
    start = checks.array("start", start)
    if start.ndim < 2:
        raise ValueError(f"start has shape {start.shape}; give an image, its rows and columns last")
    if not isinstance(model, Cameras):
        return recording
    (rows, columns), given = model.cameras[0].sensor.shape, start.shape[-2:]
    if model.pixels is not None or (given[0] <= rows and given[1] <= columns):
        return recording
    return with_field(recording, (max(given[0], rows), max(given[1], columns)))


def pinned(recording: Recording) -> Recording:
    """A recording that keeps the sensor's field, whatever is beyond; a given one stays."""
    model = recording.imaging_model
    if not isinstance(model, Cameras) or model.pixels is not None:
        return recording
    return with_field(recording, model.cameras[0].sensor.shape, whole=True)


def with_field(recording: Recording, shape: tuple[int, int], *, whole: bool = False) -> Recording:
    """A recording of `Cameras` with another field."""
    sides = {"field_shape": shape, "field_height": None, "field_width": None, "whole_scene": whole}
    model = dataclasses.replace(recording.imaging_model, **sides)
    return dataclasses.replace(recording, imaging_model=model)


def _held(light: Float[np.ndarray, " n"], size: int, least: int, most: int) -> int:
    """Fine pixels along an axis, about its middle, that hold all but a small share of the light."""
    half = light.size // 2
    beyond = np.cumsum(light[:half] + light[::-1][:half]) / light.sum()
    kept = light.size - 2 * int(np.count_nonzero(beyond < _BEYOND)) + 2
    return min(max(size * kept, least), most)
