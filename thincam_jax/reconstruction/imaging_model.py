"""Imaging models: cameras whose PSFs are computed, or PSFs that were measured."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers, Shape
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity, unchecked
from thincam_jax.imaging.defects import pedestal, wrapped, wrapped_words
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.low_rank import LowRank, Resampled
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.field import field_fit, light_over_field, tangents_of
from thincam_jax.lensless.method import MODELS, Model, PsfMethod, as_method
from thincam_jax.lensless.psf import spectral_psf

_DARK = 0.3  # share of a PSF's absolute sum
_GEOMETRY = ("cameras", "object_distance", "field_shape", "field_height", "field_width")


def _field_shape(given: Any) -> tuple[int, int] | None:
    return None if given is None else checks.shape2d("field_shape", given)


def _side(name: str, given: Any) -> float:
    return float(checks.positive(name, given, "mm"))


_SIDE = functools.partial(quantity, "mm", optional=True, check=_side)


def _cameras(given: Sequence[LenslessCamera]) -> tuple[LenslessCamera, ...]:
    if isinstance(given, LenslessCamera):
        raise TypeError("cameras is one camera; give a list, [camera], one for each capture")
    cameras = tuple(given)
    if not cameras:
        raise ValueError("cameras is empty; give one camera for each capture")
    if not all(isinstance(camera, LenslessCamera) for camera in cameras):
        raise TypeError(
            "cameras holds objects that are no LenslessCamera; give cameras, or use Psfs"
        )
    return cameras


def _model(given: Any) -> Any:
    return given if isinstance(given, PsfMethod) else checks.choice("model", given, MODELS)


class Cameras(Module):
    """Cameras whose PSFs are computed, one for each capture, with wavelength and object distance.

    **Arguments**

    - `cameras`: one for each capture. Captures at several mask-sensor distances are enlarged to
      the scale of the largest (`register`), and their PSFs with them.
    - `wavelength`: mm, one or one for each camera; or a `Spectrum`, over which PSFs are summed.
    - `object_distance`: t, mm, of the focus. Several give as many planes, each in its own
      projection: the same pixel of all planes lies on one ray through the mask.
    - `field_shape`: pixels of the image, p·t/d apart on the object, d the largest distance; the
      scene is taken as black outside. Default: those of the sensor; `AdmmTV` and `Fista` take more
      where the captures show light beyond them (`outside_light`).
    - `field_height`, `field_width`: in place of it, mm on the (nearest) object; the sensor's where
      only one is given.
    - `whole_scene`: whether the field holds the whole scene, so that no light is looked for beyond.
    - `model`, `pixel_integration`: how PSFs are computed, see `thincam_jax.psf`. With
      `PsfMethod(field_tolerance=…)` every point of one plane has its own PSF and light
      (`field_operator`), for solvers by iteration. Filters take the PSF of the axis, and divide the
      image by the light.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    optics = tc.Cameras([camera], wavelength=500 * nm, object_distance=250.0)
    recording = tc.Recording([tc.capture(camera, scene)], optics)
    ```

    **See also**: `Psfs`, `Recording`.
    """

    cameras: tuple[LenslessCamera, ...] = eqx.field(converter=_cameras)
    wavelength: Any = eqx.field(default=None, converter=unchecked("mm"), kw_only=True)
    object_distance: Any = eqx.field(default=None, converter=unchecked("mm"), kw_only=True)
    field_shape: tuple[int, int] | None = eqx.field(
        default=None, converter=_field_shape, static=True, kw_only=True
    )
    field_height: float | None = eqx.field(
        default=None, converter=_SIDE(), static=True, kw_only=True
    )
    field_width: float | None = eqx.field(
        default=None, converter=_SIDE(), static=True, kw_only=True
    )
    whole_scene: bool = eqx.field(default=False, converter=bool, static=True, kw_only=True)
    model: Model | PsfMethod = eqx.field(
        default="separable", converter=_model, static=True, kw_only=True
    )
    pixel_integration: bool = eqx.field(default=True, converter=bool, static=True, kw_only=True)

    def __check_init__(self):
        """Refuse a field in pixels and in mm."""
        if self.field_shape is not None and (self.field_height, self.field_width) != (None, None):
            raise ValueError(
                f"field_shape = {self.field_shape} and field_height or field_width are given; "
                "give pixels or mm"
            )

    def replace(self, **changes: Any) -> "Cameras":
        """The cameras with other fields; another geometry may no longer hold the whole scene."""
        if not changes.keys().isdisjoint(_GEOMETRY):
            changes = {"whole_scene": False} | changes
        return super().replace(**changes)

    @property
    def count(self) -> int:
        """Number of captures."""
        return len(self.cameras)

    @property
    def pixels(self) -> tuple[int, int] | None:
        """Pixels of the field given, of the nearest plane if in mm; None for the default."""
        sides = self.field_height, self.field_width
        if sides == (None, None):
            return self.field_shape
        pitch, sensor = self._projected(float(self._furthest.distance)), self._furthest.sensor.shape
        rows, columns = (
            n if side is None else max(1, math.ceil(side / pitch - 1e-3))
            for n, side in zip(sensor, sides, strict=True)
        )
        return rows, columns

    @property
    def seen_field(self) -> tuple[int, int]:
        """Pixels of the field whose points cast a part of a mask's shadow on its sensor."""
        sizes = []
        for camera, ratio in zip(self.cameras, distance_ratios(self.cameras), strict=True):
            pitch, distance = float(camera.sensor.pitch), float(camera.distance)
            spread = 1 + pitch / self._projected(distance)
            mask = np.asarray(camera.mask.extent) + 2 * np.abs(np.asarray(camera.mask.centre))
            if camera.place is not None:
                mask = mask + 2 * (1 - 1 / spread) * np.abs(np.asarray(camera.place))
            sizes.append(ratio * (np.array(camera.sensor.shape) + spread * mask / pitch))
        rows, columns = np.ceil(np.max(sizes, axis=0)).astype(int)
        return int(rows), int(columns)

    def _projected(self, distance: float) -> float:
        """Distance of the pixels of a camera at `distance` on the nearest object, mm."""
        self.require("object_distance")
        if checks.holds_traced(self.object_distance, self.cameras):
            raise TypeError(
                "field_height and field_width set array sizes: give field_shape, or known numbers"
            )
        return float(self._furthest.sensor.pitch) * float(np.min(self.object_distance)) / distance

    @property
    def pitch(self) -> Float[Array, "*plane"]:
        """Distance of the image's pixels on the object, mm: p·t/d of the largest d."""
        furthest = self._furthest
        return furthest.sensor.pitch * jnp.asarray(self.object_distance) / furthest.distance

    @property
    def _furthest(self) -> LenslessCamera:
        return max(self.cameras, key=lambda c: float(c.distance))

    @property
    def colours(self) -> list[list[tuple[Any, Any]]]:
        """Wavelengths of each camera's light, mm, with their weights."""
        if isinstance(self.wavelength, Spectrum):
            return [self.wavelength.colours] * self.count
        return [[(wavelength, 1.0)] for wavelength in checks.each(self.wavelengths)]

    @property
    def wavelengths(self) -> Float[Array, " camera"]:
        """λ of each camera, mm; the mean of a spectrum."""
        light = self.wavelength
        if isinstance(light, Spectrum):
            light = jnp.sum(light.wavelengths * light.weights) / jnp.sum(light.weights)
        light = checks.array("wavelength", light)
        if light.shape not in ((), (self.count,)):
            raise ValueError(
                f"wavelength has shape {light.shape}; give one number in mm, or one for each of "
                f"{self.count} cameras"
            )
        return jnp.broadcast_to(light, (self.count,))

    def require(self, *names: str) -> None:
        """Require fields that are None by default."""
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise ValueError(f"the Cameras have no {' and no '.join(missing)}; give it in mm")

    @property
    def over_field(self) -> bool:
        """Whether every point of the field has its own PSF."""
        return isinstance(self.model, PsfMethod) and self.model.field_tolerance is not None

    def light(self, field: tuple[int, int]) -> Float[Array, "m n"]:
        """Light of a field's points, 1 on the axis; one 1 for all without a `field_tolerance`."""
        if not self.over_field:
            return checks.as_array(np.ones((1, 1)))
        sensor, tangents = self._furthest.sensor, tangents_of(self._furthest, field)
        return jnp.asarray(light_over_field(sensor, *tangents))

    def field_operators(self, field: tuple[int, int]) -> tuple[LowRank | Resampled, ...]:
        """The operator of each camera over its field, from the object as it lies on the sensor.

        On that of the largest distance; cameras at others interpolate it on their own scale.
        """
        self.require("wavelength", "object_distance")
        if np.ndim(self.object_distance):
            raise ValueError(
                "PSFs over the field are for one object_distance; give one, or no field_tolerance"
            )
        method, distance = as_method(self.model, self.pixel_integration), self.object_distance
        ratios, operators = distance_ratios(self.cameras), []
        for camera, colours, ratio in zip(self.cameras, self.colours, ratios, strict=True):
            own = own_field(field, ratio)
            one = field_fit(camera, colours, distance, own, method).operator
            dtype, sizes = one.weights.dtype, zip(field, own, strict=True)
            matrices = (_coarser(n, few, ratio).astype(dtype) for n, few in sizes)
            operators.append(one if ratio == 1 else Resampled(one, *matrices))
        return tuple(operators)

    def kernels(
        self, field: tuple[int, int], ratios: Sequence[float]
    ) -> list[Float[Array, "1 plane k l"]]:
        """PSF of each camera and plane on the reference scale; enlarged by r, 1/r² as bright."""
        self.require("wavelength", "object_distance")
        distances = np.atleast_1d(np.asarray(self.object_distance, dtype=object))
        if not distances.size:
            raise ValueError("object_distance is empty; give one in mm, or one for each plane")
        kernels = []
        for number, ratio in zip(range(self.count), ratios, strict=True):
            own = own_field(field, ratio)
            planes = [self.own_psf(number, own, distance) for distance in distances]
            own_scale = [k if ratio == 1 else register(k, ratio) / ratio**2 for k in planes]
            kernels.append(checks.stacked([checks.stacked(own_scale)]))
        return kernels

    def own_psf(self, number: int, field: tuple[int, int], distance: Number) -> Float[Array, "k l"]:
        """PSF of a camera on its own scale, on all pixels by which a field reaches its sensor."""
        camera, method = self.cameras[number], as_method(self.model, self.pixel_integration)
        grid = kernel_grid(camera.sensor.grid, field)
        return spectral_psf(camera, self.colours[number], distance, method, grid)


_PSF_SHAPE = (
    "PSFs have shape {}; give (capture, k, l), such as psf[None] for one, (capture, channel, k, l) "
    "or (capture, channel, plane, k, l)"
)


class Psfs(Module):
    """Measured PSFs on the pixels of the captures, one for each capture.

    **Arguments**

    - `psfs`: (capture, k, l), (capture, channel, k, l) or (capture, channel, plane, k, l), the
      channel axis of length 1 or that of the captures.
    - `field_shape`: pixels of the field; default the extent that reaches the sensor, sensor +
      PSF − 1, of which the image is the part in front of the sensor.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.AdmmTV(iterations=10))
    ```

    **See also**: `Cameras`, `Recording`, `check_psf`.
    """

    psfs: Float[Array, "capture channel plane k l"]
    field_shape: tuple[int, int] | None = eqx.field(static=True)

    def __init__(self, psfs: Numbers, *, field_shape: Shape | None = None):
        if isinstance(psfs, np.ndarray) and (share := wrapped(psfs)):
            raise ValueError(f"psfs: {wrapped_words(share)}")
        psfs = checks.array("psfs", psfs)
        if not 3 <= psfs.ndim <= 5 or 0 in psfs.shape:
            raise ValueError(_PSF_SHAPE.format(psfs.shape))
        checks.channels_first("psfs", psfs.shape)
        _require_light(psfs)
        self.psfs = psfs.reshape(*psfs.shape[:-2], *(1,) * (5 - psfs.ndim), *psfs.shape[-2:])
        self.field_shape = _field_shape(field_shape)

    @property
    def count(self) -> int:
        """Number of captures."""
        return self.psfs.shape[0]


def _require_light(psfs: Array) -> None:
    """Require finite PSFs that are not mostly negative."""
    if checks.is_traced(psfs):
        return
    values = np.asarray(psfs)
    if not np.isfinite(values).all():
        raise ValueError("the PSFs hold NaN or infinity; give finite irradiances")
    if not values.any():
        raise ValueError("the PSFs are zero everywhere; give positive irradiances")
    light = values.sum(axis=(-2, -1), dtype=float)
    # Differences of PSFs have sums of about zero, of either sign.
    if (light < -_DARK * np.abs(values).sum(axis=(-2, -1), dtype=float)).any():
        raise ValueError(
            f"a PSF sums to {light.min():.3g}, which is negative: too large a background was "
            "subtracted, or its sign is wrong; give PSFs of positive irradiance"
        )


def pedestal_of(model: object) -> str:
    """A sentence where measured PSFs stand on a pedestal, with what to subtract, else nothing."""
    if not isinstance(model, Psfs) or checks.is_traced(model.psfs):
        return ""
    level, share = pedestal(np.asarray(model.psfs))
    if level == 0:
        return ""
    if level < 0:
        return (
            f"a PSF is {level:.3g} where it is dark, {-100 * share:.0f} % of its mean light below "
            f"0: too large a background was subtracted; give tc.Psfs(psfs + {-level:.3g})"
        )
    return (
        f"a PSF is {level:.3g} where it is dark, {100 * share:.0f} % of its mean: give "
        f"tc.Psfs(psfs - {level:.3g}), of files --psf-background"
    )


def registered_shape(shape: tuple[int, int], ratio: float) -> tuple[int, int]:
    """Shape of a capture enlarged by `ratio` ≥ 1, of the same parity."""
    rows, columns = (n + 2 * math.ceil((n * ratio - n) / 2 - 1e-6) for n in shape)
    return rows, columns


def register(image: Float[Array, "*batch y x"], ratio: float) -> Float[Array, "*batch v u"]:
    """A capture enlarged about its centre by `ratio` = d_ref/d ≥ 1, at the same pitch.

    A scene point's shadow moves by d/t, so the enlarged capture is on the scale of one at d_ref.
    Lanczos interpolation; outside the sensor it is zero.
    """
    if ratio < 1:
        raise ValueError(
            f"ratio = {ratio:g}: captures are only enlarged; give a ratio of at least 1"
        )
    if ratio == 1:
        return image
    rows, columns = registered_shape((image.shape[-2], image.shape[-1]), ratio)
    refuse_if_too_large(
        f"a capture enlarged {ratio:g} times",
        rows * columns * image.dtype.itemsize,
        "give cameras whose distances are less apart",
    )
    tall = _enlarged(jnp.moveaxis(image, -2, 0), rows, ratio)
    return jnp.moveaxis(_enlarged(jnp.moveaxis(tall, -1, 0), columns, ratio), (1, 0), (-2, -1))


# Samples that are interpolated by one product of matrices, and lobes of Lanczos' window.
_TOGETHER, _LOBES = 128, 5


def _enlarged(lines: Float[Array, "n *rest"], count: int, ratio: float) -> Float[Array, "m *rest"]:
    """Lanczos interpolation at `count` places, 1/ratio apart about the same middle."""
    whole = len(lines)
    width = min(whole, math.ceil(_TOGETHER / ratio) + 2 * _LOBES)
    number = np.arange(-(-count // _TOGETHER) * _TOGETHER).reshape(-1, _TOGETHER, 1)
    place = (number - (count - 1) / 2) / ratio + (whole - 1) / 2
    first = np.clip(np.floor(place[:, :1]).astype(int) + 1 - _LOBES, 0, whole - width)
    taken = first + np.arange(width)
    away = place - taken
    weights = np.sinc(away) * np.sinc(away / _LOBES) * (np.abs(away) < _LOBES)
    inside = np.abs(place - (whole - 1) / 2) < whole / 2 - 1e-9  # not on the rim
    total = np.where(inside, weights.sum(axis=-1, keepdims=True), 1)
    weights = (weights * inside / total).astype(lines.dtype)
    enlarged = jnp.einsum("bmn,bn...->bm...", weights, lines[taken[:, 0]], precision="highest")
    return enlarged.reshape(-1, *lines.shape[1:])[:count]


def _coarser(count: int, few: int, ratio: float) -> Float[Array, "few count"]:
    """Matrix from samples to those `ratio` times as far apart, about the same middle (Lanczos)."""
    scale, start = jnp.asarray([1 / ratio]), jnp.asarray([(few - count / ratio) / 2])
    shape, every = (few, count), jnp.eye(count)
    return jax.image.scale_and_translate(every, shape, (0,), scale, start, method="lanczos5")


def distance_ratios(cameras: Sequence[LenslessCamera]) -> list[float]:
    """Enlargement of each camera's captures: largest distance over its own."""
    if any(checks.is_traced(c.distance) for c in cameras):
        raise TypeError(
            "the cameras' distances are traced, but set array sizes: give them as known numbers"
        )
    distances = [float(c.distance) for c in cameras]
    return [max(distances) / d for d in distances]


def own_field(field_shape: tuple[int, int], ratio: float) -> tuple[int, int]:
    """The field in samples of a camera's own scale, `ratio` times coarser, of the same parity."""
    rows, columns = (n - 2 * math.floor((n - n / ratio) / 2 + 1e-6) for n in field_shape)
    return rows, columns
