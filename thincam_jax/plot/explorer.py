"""A camera whose numbers are turned by hand: the controls, and the pictures of each setting."""

import dataclasses
import functools
import math
import operator
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.controls import Control, View, turned
from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import Quantity
from thincam_jax.imaging.encoding import jpeg_bytes, png_bytes
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.imaging.metrics.mtf import cut_off, first_common_zero, low_frequency_value
from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.imaging.sensor import GaussianNoise
from thincam_jax.imaging.targets import sample_image
from thincam_jax.lensless import psf as psfs
from thincam_jax.lensless.accuracy.select import choose_model
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.capture import capture
from thincam_jax.lensless.masks.base import has_few_terms
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import PIXEL_NODES, PsfMethod, pixel_nodes
from thincam_jax.lensless.phase_shift import fringe_scanned_otf, with_phase, without_carrier
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.methods import reconstruct
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.wiener import Wiener
from thincam_jax.units import nm

# Part of the sensor's width that the scene's image has.
_FILLED = 0.7
# How far a control goes below and above its value.
_LOWEST, _HIGHEST = 0.25, 2.5
_SNR_DB = 30.0
_MOST_PIXELS = 2048  # of a sensor's side
_ANGLE = Control("angle", "angle off the axis", "°", -30.0, 30.0, 0.0, math.pi / 180)
_TOLERANCE = Control("tolerance", "tolerance", "%", 0.1, 20.0, 1.0, 1e-2)


@checked
class Explorer:
    """The settings of a camera, and what it sees with each.

    While a control is moved the PSF and the transfer function follow, by one compiled program: new
    values are not compiled for. At rest come a noisy capture of the scene (30 dB), its Wiener
    reconstruction (of four captures by fringe scanning where the mask is a zone aperture), and the
    cheapest model within the tolerance that is set. The scene keeps its size on the sensor, 0.7 of
    its width, and is about the axis. Of masks of few terms the PSF is about a ray at an angle.

    **Arguments**

    - `camera`: any lensless camera of up to 2048 pixels a side.
    - `scene`: an image (y, x), radiance; default a photograph.
    - `wavelength`, `object_distance`: mm, where the controls begin.
    """

    captions, live = None, False  # see `Controlled`

    def __init__(
        self,
        camera: LenslessCamera,
        scene: Any = None,
        *,
        wavelength: Number = 550 * nm,
        object_distance: Number = 250.0,
    ):
        if max(camera.sensor.shape) > _MOST_PIXELS:
            raise ValueError(
                f"the sensor has {camera.sensor.shape} pixels; give one of at most {_MOST_PIXELS} "
                "a side to explore"
            )
        image = sample_image("camera", linear=True) if scene is None else scene
        self.scene = ImagePlane(image, distance=1.0, width=1.0).image  # checked there
        if self.scene.ndim != 2:
            raise ValueError(f"scene has shape {self.scene.shape}; give one image (y, x)")
        self._first = camera
        light: dict[str, Any] = {
            "wavelength": float(checks.wavelength("wavelength", wavelength)),
            "object_distance": float(checks.positive("object_distance", object_distance, "mm")),
        }
        self.controls = (*_controls_of(camera), *_controls_of_light(**light), _TOLERANCE)
        nodes = None
        if has_few_terms(camera.mask):  # counted for the camera given: known numbers decide
            path = camera.path(**light)
            counted = pixel_nodes(camera.mask, camera.sensor.grid, path, "float64")
            nodes = max(PIXEL_NODES, counted)
        # The camera is known, not traced: so is then that the point lies on an axis of the mask.
        self._moving = jax.jit(functools.partial(_moving, camera, PsfMethod(nodes=nodes)))
        self.values = {control.name: control.value for control in self.controls}

    @property
    def camera(self) -> LenslessCamera:
        """The camera as it is set."""
        return _with_numbers(self._first, self._numbers())

    @property
    def light(self) -> dict[str, Any]:
        """Wavelength and object distance as they are set, mm: keyword arguments of `tc.psf`."""
        numbers = self._numbers()
        return {name: numbers[name] for name in ("wavelength", "object_distance")}

    @property
    def at(self) -> tuple[float, float]:
        """(y, x) of the PSF's point as it is set, mm: `at` of `tc.psf`."""
        return _point(self._numbers())

    def turn(self, values: dict[str, float]) -> None:
        """Set controls, each within its range; ValueError names one that does not exist."""
        self.values |= turned(self.controls, values)

    def view(self, *, rest: bool = True) -> View:
        """The pictures of the setting; those that take long only at rest."""
        like, numbers = self._first.distance.dtype, self._numbers()
        if rest:
            drawn = _moving(self._first, PsfMethod(), numbers)
        else:
            drawn = self._moving({name: jnp.asarray(n, like) for name, n in numbers.items()})
        levels, profile = jax.device_get(drawn)
        step = 1 / (self._first.sensor.shape[1] * float(self._first.sensor.pitch))
        frequency = np.arange(1, profile.size) * step
        magnitude = np.abs(profile[1:])
        low = low_frequency_value(frequency, magnitude)
        seen = View(
            dict(self.values),
            {"psf": _file(levels, rest)},
            step,
            magnitude / (low if low > 0 else 1.0),
            float(cut_off(frequency, magnitude)) if low > 0 else 0.0,
        )
        return self._at_rest(seen) if rest else seen

    def _numbers(self) -> dict[str, float]:
        return {one.name: self.values[one.name] * one.scale for one in self.controls}

    def _at_rest(self, seen: View) -> View:
        camera, light = self.camera, self.light
        plane, field = self._placed(camera, light["object_distance"])
        scene = Scene(plane, light["wavelength"])
        # A zone aperture takes four captures, whose background cancels.
        scanned = isinstance(camera.mask, FresnelZoneAperture)
        taken = [with_phase(camera, step / 4) for step in range(4)] if scanned else [camera]
        noise = GaussianNoise(_SNR_DB, "without_mean")
        noisy = [capture(one, scene, noise=noise, key=seed) for seed, one in enumerate(taken)]
        recording = Recording(noisy, Cameras(taken, field_shape=field, **light))
        found = reconstruct(recording, FringeScanning() if scanned else Wiener())
        assert found.pitch is not None
        grid = Grid(found.image.shape, found.pitch)
        truth = np.asarray(plane.sample(grid, magnification=1.0))
        rows, columns = camera.sensor.shape
        lines = (
            f"{'Four captures' if scanned else 'One capture'} of {rows}×{columns} pixels at "
            f"{_SNR_DB:g} dB, {'fringe scanning' if scanned else 'Wiener filter'}: "
            f"{psnr(found.image, truth):.1f} dB.",
            *self._about_the_psf(camera, light),
        )
        pictures = {"capture": _stretched(np.asarray(noisy[0])), "image": align(found.image, truth)}
        files = {name: _file(image, True) for name, image in pictures.items()}
        return replace(seen, pictures=seen.pictures | files, zero=_zero(camera, light), lines=lines)

    def _about_the_psf(self, camera: LenslessCamera, light: dict[str, Any]) -> list[str]:
        """Changes by a cheaper model, and by the angle."""
        tolerance = self.values["tolerance"]
        chosen = choose_model(camera, tolerance=tolerance * _TOLERANCE.scale, **light)
        h = psfs.psf(camera, **light)
        other = psfs.psf(camera, model=chosen.method, **light)
        found = [
            f"A PSF within {tolerance:.3g} %: model {chosen.method.model}, predicted error "
            f"{chosen.predicted_error:.1e}; from the one drawn it differs by "
            f"{_change(other, h):.2g}."
        ]
        if any(self.at):
            off = psfs.psf_about_ray(camera, **light, at=self.at, method=PsfMethod())
            angle = self.values["angle"]
            found.append(
                f"PSF and transfer function are about the ray at {angle:.3g}°, "
                f"{_change(off, h):.2g} from the axis'; capture and image are of the axis."
            )
        return found

    def _placed(self, camera: LenslessCamera, distance: float) -> tuple[ImagePlane, Any]:
        """The scene at a distance, and the pixels of its image (y, x)."""
        rows, columns = self.scene.shape
        sensor = camera.sensor
        # Of the larger scene that fits both sides.
        across = _FILLED * min(sensor.shape[1], sensor.shape[0] * columns / rows)
        field = max(2, round(across * rows / columns)), max(2, round(across))
        width = field[1] * float(sensor.pitch) * distance / float(camera.distance)
        return ImagePlane(self.scene, distance=distance, width=width), field


def _controls_of(camera: LenslessCamera) -> list[Control]:
    """The mask's own numbers, and its distance."""
    found = []
    for field in dataclasses.fields(camera.mask):
        converter, value = field.metadata.get("converter"), getattr(camera.mask, field.name)
        if isinstance(converter, Quantity) and isinstance(value, jax.Array) and value.ndim == 0:
            found.append(_control(field.name, converter, float(value)))
    distance = {field.name: field for field in dataclasses.fields(camera)}["distance"]
    found.append(_control("distance", distance.metadata["converter"], float(camera.distance)))
    return [*found, _ANGLE] if has_few_terms(camera.mask) else found


def _control(name: str, quantity: Quantity, value: float) -> Control:
    label = name.replace("_", " ")
    if quantity.unit == "rad":
        return Control(name, label, "rad", -math.pi, math.pi, value)
    high = value * _HIGHEST
    try:
        quantity(high)
    except ValueError:  # as of a fraction that is at most 1
        high = value
    low, high, value = (float(f"{one:.6g}") for one in (value * _LOWEST, high, value))
    return Control(name, label, quantity.symbol, low, high, value)


def _controls_of_light(wavelength: float, object_distance: float) -> list[Control]:
    far = 1000.0 if math.isinf(object_distance) else object_distance
    return [
        Control("wavelength", "wavelength", "nm", 380.0, 780.0, round(wavelength / nm, 3), nm),
        Control("object_distance", "object distance", "mm", far / 10, 4 * far, far),
    ]


def _with_numbers(camera: LenslessCamera, numbers: dict[str, Any]) -> LenslessCamera:
    for name, value in numbers.items():
        own = name == "distance"
        if own or hasattr(camera.mask, name):  # others are of the light
            value = jnp.asarray(value, camera.distance.dtype)
            inside = operator.attrgetter(name if own else f"mask.{name}")
            camera = eqx.tree_at(inside, camera, value)
    return camera


def _point(numbers: dict[str, Any]) -> tuple[float, Any]:
    """(y, x) of the object's point at an angle along x."""
    angle = numbers.get("angle", 0.0)
    tangent = math.tan(angle) if isinstance(angle, float) else jnp.tan(angle)
    return 0.0, numbers["object_distance"] * tangent


def _moving(camera: LenslessCamera, method: PsfMethod, numbers: dict[str, Any]) -> tuple[Any, Any]:
    """The PSF as 256 grey levels, and the OTF along u ≥ 0 at v = 0."""
    light: dict[str, Any] = {name: numbers[name] for name in ("wavelength", "object_distance")}
    camera, at = _with_numbers(camera, numbers), _point(numbers) if "angle" in numbers else None
    h = psfs.psf_about_ray(camera, **light, at=at, method=method)
    largest = jnp.max(h)
    levels = jnp.round(255 * h / jnp.where(largest > 0, largest, 1)).astype(jnp.uint8)
    # The spectrum along u is that of the sum over y; its phase about the middle pixel.
    columns = h.shape[1]
    profile = jnp.fft.rfft(jnp.fft.ifftshift(jnp.sum(h, axis=0)))[: columns - columns // 2]
    return levels, profile


def _zero(camera: LenslessCamera, light: dict[str, Any]) -> float | None:
    """The first zero of fringe scanning with a zone aperture, cycles/mm."""
    mask = camera.mask
    if not isinstance(mask, FresnelZoneAperture):
        return None
    columns = camera.sensor.shape[1]
    response = np.asarray(fringe_scanned_otf(camera, **light))
    profile = response[camera.sensor.shape[0] // 2, columns // 2 :]
    u = np.arange(profile.size) / (columns * float(camera.sensor.pitch))
    shadow = 1 + float(camera.distance) / light["object_distance"]
    return first_common_zero(u, [without_carrier(u, profile, float(mask.beta), shadow)])


def _change(image: jax.Array, reference: jax.Array) -> float:
    """‖image − reference‖₂ / ‖reference‖₂."""
    exact = np.asarray(reference, float)
    return float(np.linalg.norm(np.asarray(image, float) - exact) / np.linalg.norm(exact))


def _stretched(image: np.ndarray) -> np.ndarray:
    low, high = image.min(), image.max()
    return (image - low) / (high - low if high > low else 1)


def _file(image: np.ndarray, rest: bool) -> bytes:
    """PNG of an image of 0…1 or 256 levels at rest, else JPEG."""
    if image.dtype != np.uint8:
        image = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
    if rest:
        return png_bytes(image)
    return jpeg_bytes(image)
