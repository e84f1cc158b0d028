"""Whether a plan is run on what it was made for."""

import jax
import numpy as np

from thincam_jax._core import checks
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.exposure import projected_shape
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.plan.records import Plan

# How far a camera's numbers may be from the plan's, relative.
_NEAR = 0.01


def require_fits(plan: Plan, camera: LenslessCamera, scene: Scene) -> None:
    """ValueError where camera or scene are not the plan's. Traced numbers cannot be looked at."""
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
    """Names of what differs by more than a search's steps; the mask's phase may be any."""
    if jax.tree.structure(own.mask) != jax.tree.structure(camera.mask):
        return ["mask"]
    if own.sensor.shape != camera.sensor.shape:
        return ["sensor.shape"]
    width = own.mask.extent[0]
    numbers = {
        "sensor.pitch": (own.sensor.pitch, camera.sensor.pitch, own.sensor.pitch),
        "distance": (own.distance, camera.distance, own.distance),
        "mask.width": (width, camera.mask.extent[0], width),
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
