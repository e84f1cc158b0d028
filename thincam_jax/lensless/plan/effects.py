"""Effects in a capture beside its model's optics, with sizes."""

import math
from dataclasses import dataclass

import numpy as np

from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.select import probe_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.light import light_over_field
from thincam_jax.lensless.method import has_few_terms
from thincam_jax.lensless.propagation.obliquity import psf_change


@dataclass(frozen=True)
class Effect:
    """An effect of the camera and whether the plan models it.

    - `size`: relative to the capture; None where it is not known.
    """

    name: str
    modelled: bool
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
        return Effect("shift-variance", False, None, note)
    slope = max(math.hypot(p.height, p.width) / 2 / float(p.distance) for p in scene.planes)
    wavelength = float(max(scene.spectrum.wavelengths))
    size = psf_change(wavelength, float(camera.distance), float(finest), math.cos(math.atan(slope)))
    what = f"the PSF at {math.degrees(math.atan(slope)):.0f}° against the axis"
    verdict = "matters: see PsfMethod's field_tolerance" if size > tolerance else "does not matter"
    return Effect("shift-variance", False, size, f"{what}: about {size:.1e}, {verdict}")


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
    return Effect(
        "obliquity", False, size, _left_out(size, tolerance, "fall of light over the field")
    )


def _left_out(size: float, tolerance: float, what: str) -> str:
    verdict = "matters, and is not modelled" if size > tolerance else "does not matter"
    return f"{what}: about {size:.1e}, {verdict}"


def _shot_noise(camera: LenslessCamera, tolerance: float) -> Effect:
    """Relative shot noise of the brightest pixel: 1/√N for its N electrons."""
    sensor = camera.sensor
    if sensor.electrons is not None:
        note = "size not known: the brightest pixel depends on the scene's light"
        return Effect("shot noise", False, None, note)
    if sensor.exposure is None:
        note = "size not known: give the Sensor an exposure, such as 0.9"
        return Effect("shot noise", False, None, note)
    size = 1 / math.sqrt(float(sensor.exposure * sensor.full_well))
    what = "matters: pass noise=PoissonGaussianNoise()" if size > tolerance else "does not matter"
    return Effect("shot noise", False, size, f"about {size:.1e} a pixel, {what}")


def _fresnel(camera, scene: Scene, tolerance: float) -> Effect:
    """Exact scalar diffraction against Fresnel's, for the nearest plane."""
    if not has_few_terms(camera.mask):
        if camera.mask.exact_model:
            return Effect("exact phases", False, None, "Fresnel's; size not known for this mask")
        return Effect("exact phases", True, None, "those of exact scalar diffraction are modelled")
    distance = min(float(plane.distance) for plane in scene.planes)
    wavelength = max(float(w) for w in scene.spectrum.wavelengths)
    size = probe_of(camera, wavelength, distance, True).paraxial_error()
    note = _left_out(size, tolerance, "Fresnel's approximation of the PSF")
    return Effect("exact phases", False, size, note)
