"""A plan: whether it is run on what it was made for, and carrying it out."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.memory import Cost, readable, refuse_if_too_large
from thincam_jax._core.precision import allow, cast, precision_of
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.select import probe_of
from thincam_jax.lensless.camera import LenslessCamera, psf_change
from thincam_jax.lensless.field import light_over_field
from thincam_jax.lensless.forward import operator_of, project, projected_shape
from thincam_jax.lensless.masks.base import has_few_terms
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import SAMPLED, PsfMethod


@dataclass(frozen=True)
class Effect:
    """An effect that the plan leaves out or, as a note says, models.

    - `size`: relative to the capture; None where it is not known.
    """

    name: str
    size: float | None
    note: str


def effects_of(
    camera: LenslessCamera, scene: Scene, tolerance: float, over_field: bool
) -> tuple[Effect, ...]:
    """Shot noise, Fresnel's approximation, and what changes over the field.

    The last unless the plan decides `over_field`.
    """
    always = _shot_noise(camera, tolerance), _fresnel(camera, scene, tolerance)
    if over_field:
        return always
    return _shift_variance(camera, scene, tolerance), _obliquity(camera, scene, tolerance), *always


def _shift_variance(camera: LenslessCamera, scene: Scene, tolerance: float) -> Effect:
    """Change of the PSF from the axis to the corner of the widest plane."""
    finest = camera.mask.finest_frequency
    if finest is None:
        note = "size not known for this mask: compare psf(..., at=(y, x)) with that of the axis"
        return Effect("shift-variance", None, note)
    slope = max(math.hypot(p.height, p.width) / 2 / float(p.distance) for p in scene.planes)
    wavelength = float(max(scene.spectrum.wavelengths))
    size = psf_change(wavelength, float(camera.distance), float(finest), math.cos(math.atan(slope)))
    what = f"the PSF at {math.degrees(math.atan(slope)):.0f}° against the axis"
    verdict = "matters: see PsfMethod's field_tolerance" if size > tolerance else "does not matter"
    return Effect("shift-variance", size, f"{what}: about {size:.1e}, {verdict}")


def _obliquity(camera: LenslessCamera, scene: Scene, tolerance: float) -> Effect:
    """Fall of light towards the edge of the field, averaged over the planes."""
    falls = []
    for plane in scene.planes:
        y, x = (
            np.linspace(-0.5, 0.5, 33) * float(n) / float(plane.distance)
            for n in (plane.height, plane.width)
        )
        falls.append(np.mean((1 - np.asarray(light_over_field(camera.sensor, y, x))) ** 2))
    size = math.sqrt(float(np.mean(falls)))
    return Effect("obliquity", size, _left_out(size, tolerance, "fall of light over the field"))


def _left_out(size: float, tolerance: float, what: str) -> str:
    verdict = "matters, and is not modelled" if size > tolerance else "does not matter"
    return f"{what}: about {size:.1e}, {verdict}"


def _shot_noise(camera: LenslessCamera, tolerance: float) -> Effect:
    """Relative shot noise of the brightest pixel: 1/√N for its N electrons."""
    sensor = camera.sensor
    if sensor.electrons is not None:
        note = "size not known: the brightest pixel depends on the scene's light"
        return Effect("shot noise", None, note)
    if sensor.exposure is None:
        note = "size not known: give the Sensor an exposure, such as 0.9"
        return Effect("shot noise", None, note)
    size = 1 / math.sqrt(float(sensor.exposure * sensor.full_well))
    what = "matters: pass noise=PoissonGaussianNoise()" if size > tolerance else "does not matter"
    return Effect("shot noise", size, f"about {size:.1e} a pixel, {what}")


def _fresnel(camera, scene: Scene, tolerance: float) -> Effect:
    """Exact scalar diffraction against Fresnel's, for the nearest plane."""
    if not has_few_terms(camera.mask):
        if camera.mask.exact_model:
            return Effect("exact phases", None, "Fresnel's; size not known for this mask")
        return Effect("exact phases", None, "those of exact scalar diffraction are modelled")
    distance = min(float(plane.distance) for plane in scene.planes)
    wavelength = max(float(w) for w in scene.spectrum.wavelengths)
    size = probe_of(camera, wavelength, distance, True).paraxial_error()
    note = _left_out(size, tolerance, "Fresnel's approximation of the PSF")
    return Effect("exact phases", size, note)


# How far a camera's numbers may be from the plan's, relative.
_NEAR = 0.01


@dataclass(frozen=True, eq=False)
class CapturePlan:
    """Plan by which `capture` computes a scene within a tolerance; by `plan_capture`.

    Print it for a table. It holds for scenes with the same planes and wavelengths as the one that
    it was made for and images like its, and for cameras within 1 % of its own, at any phase of the
    mask.

    - `camera`: camera of the plan.
    - `tolerance`, `predicted_error`: relative L2 error of the noise-free capture, of a
      batch as a whole.
    - `method`: model of the PSFs with its settings, which `psf` takes.
    - `distances`: object distances in mm whose PSFs are computed, out of the scene's.
    - `mixing`: (distance, plane) weights: the PSF of a plane is this sum of the computed ones, so
      that planes are merged before they are convolved.
    - `wavelengths`, `weights`: wavelengths in mm that are computed, and their shares of the light.
    - `scene_distances`, `scene_wavelengths`, `scene_weights`: distances and light of the scene that
      the plan was made for.
    - `field_shape`: samples of the largest projected plane on the sensor's pitch.
    - `padded_shape`: window of the convolutions.
    - `cost`, `full_cost`: cost of the plan, and of computing every plane and wavelength.
    - `shares`: predicted errors of the single decisions.
    - `effects`: effects that the capture holds and those that it leaves out.
    """

    camera: LenslessCamera
    tolerance: float
    predicted_error: float
    method: PsfMethod
    distances: tuple[float, ...]
    mixing: Float[np.ndarray, "distance plane"]
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    scene_distances: tuple[float, ...]
    scene_wavelengths: tuple[float, ...]
    scene_weights: tuple[float, ...]
    field_shape: tuple[int, int]
    padded_shape: tuple[int, int]
    cost: Cost
    full_cost: Cost
    shares: dict[str, float]
    effects: tuple[Effect, ...]

    @property
    def meets_tolerance(self) -> bool:
        """False where no way of computing meets the tolerance; the plan is then the best one."""
        return self.predicted_error <= self.tolerance

    @property
    def _field(self) -> str:
        tolerance = self.method.field_tolerance
        if tolerance is None:
            return "the PSF and the light of the axis"
        if tolerance >= 1:
            return "the PSF of the axis, the light of every point"
        return f"every point with its own PSF, within {tolerance:.1e}, and light"

    def __str__(self) -> str:
        method = self.method
        average = "averaged over pixels" if method.pixel_integration else "at the pixels' centres"
        if method.model in SAMPLED:
            average = f"{method.samples}×{method.samples} samples a pixel"
        planes, colours = len(self.scene_distances), len(self.scene_wavelengths)
        shares = self.shares
        rows, columns = self.field_shape
        met = "" if self.meets_tolerance else "  NOT MET"
        lines = [
            ("tolerance", f"{self.tolerance:.1e}, predicted {self.predicted_error:.1e}{met}"),
            ("model", f"{method.model}, {method.precision}, {average}: {shares['model']:.1e}"),
            ("field", f"{self._field}: {shares['field']:.1e}"),
            ("depth planes", f"{planes} by {len(self.distances)} PSFs: {shares['planes']:.1e}"),
            ("wavelengths", f"{colours} by {len(self.wavelengths)}: {shares['wavelengths']:.1e}"),
            (
                "convolution",
                f"field {rows}×{columns}, window {self.padded_shape[0]}×{self.padded_shape[1]}",
            ),
            *((effect.name, effect.note) for effect in self.effects),
            (
                "cost",
                f"{self.cost.flops:.1e} operations of {self.full_cost.flops:.1e} in full, "
                f"{readable(self.cost.bytes)}",
            ),
        ]
        width = max(len(name) for name, _ in lines)
        return "\n".join(f"{name:<{width}}  {text}" for name, text in lines)


def run_plan(plan: CapturePlan, camera: LenslessCamera, scene: Scene) -> Float[Array, "*batch y x"]:
    """The noise-free capture: planes mixed, convolved with the planned PSFs, and added up."""
    require_fits(plan, camera, scene)
    own = precision_of(camera.sensor.pitch)
    rows, columns = camera.sensor.shape
    refuse_if_too_large(
        f"the planned capture of {rows}×{columns} pixels",
        plan.cost.bytes,
        "use a smaller sensor, a smaller scene, or fewer images at a time",
    )
    with allow(plan.method.float_type, camera, scene):
        camera, scene = cast((camera, scene), plan.method.float_type)
        fields = jnp.stack([project(camera, p, plan.field_shape) for p in scene.planes])
        mixed = jnp.tensordot(
            jnp.asarray(plan.mixing, fields.dtype), fields, axes=1, precision="highest"
        )
        light = tuple(zip(plan.wavelengths, plan.weights, strict=True))
        total = jnp.zeros((), fields.dtype)
        for distance, field in zip(plan.distances, mixed, strict=True):
            operator = operator_of(camera, light, distance, plan.field_shape, plan.method)
            total = total + operator(field)
    return cast(total, own)


def require_fits(plan: CapturePlan, camera: LenslessCamera, scene: Scene) -> None:
    """ValueError where camera or scene are not the plan's. Traced numbers are not checked."""
    other = _other_numbers(plan.camera, camera)
    if other:
        raise ValueError(
            f"the plan is for another camera ({', '.join(other)} differ): make a plan for this one"
        )
    distances = [plane.distance for plane in scene.planes]
    spectrum = scene.spectrum
    for what, given, planned in (
        ("planes at given distances", distances, plan.scene_distances),
        ("given wavelengths", spectrum.wavelengths, plan.scene_wavelengths),
        ("given weights of them", spectrum.weights, plan.scene_weights),
    ):
        if not _same(given, planned):
            raise ValueError(
                f"the plan is for {len(planned)} {what}, the scene has others: make a plan for it"
            )
    widths = [plane.width for plane in scene.planes]
    if any(checks.is_traced(n) for n in (*distances, *widths, camera.distance)):
        return
    shapes = [projected_shape(camera, plane) for plane in scene.planes]
    needed = max(s[0] for s in shapes), max(s[1] for s in shapes)
    if any(n > p for n, p in zip(needed, plan.field_shape, strict=True)):
        raise ValueError(
            f"the plan is for planes that cover {plan.field_shape} samples on the sensor, the "
            f"scene's cover {needed}: make a plan for it"
        )


def _same(given, planned) -> bool:
    if len(given) != len(planned):
        return False
    if any(checks.is_traced(n) for n in jax.tree.leaves(given)):
        return True
    return np.allclose(np.asarray(given, float), planned, rtol=1e-6)


def _other_numbers(own: LenslessCamera, camera: LenslessCamera) -> list[str]:
    """Names of the numbers that differ by more than 1 %; the mask's phase is not compared."""
    if jax.tree.structure(own.mask) != jax.tree.structure(camera.mask):
        return ["mask"]
    if own.sensor.shape != camera.sensor.shape:
        return ["sensor.shape"]
    width = own.mask.extent[0]
    numbers = {
        "sensor.pitch": (own.sensor.pitch, camera.sensor.pitch, own.sensor.pitch),
        "distance": (own.distance, camera.distance, own.distance),
        "mask.width": (own.mask.extent[1], camera.mask.extent[1], width),
        "mask.height": (own.mask.extent[0], camera.mask.extent[0], width),
        "mask.centre": (own.mask.centre, camera.mask.centre, width),
    }
    if isinstance(own.mask, FresnelZoneAperture) and isinstance(camera.mask, FresnelZoneAperture):
        numbers["mask.beta"] = own.mask.beta, camera.mask.beta, own.mask.beta
    return [
        name
        for name, (first, second, scale) in numbers.items()
        if not checks.is_traced(second)
        and np.abs(np.asarray(first) - np.asarray(second)).max() > _NEAR * float(scale)
    ]
