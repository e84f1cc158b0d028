"""Carrying out a plan."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax import _checks
from thincam_jax._precision import allow, cast, precision_of
from thincam_jax.camera import LenslessCamera
from thincam_jax.imaging import check_memory, project, spectral_psf
from thincam_jax.operators import CropConvolution, kernel_grid
from thincam_jax.planning.plan import Plan
from thincam_jax.scene import Scene

# How far a camera may be from the plan's, relative.
_NEAR = 0.01


def run_plan(plan: Plan, camera: LenslessCamera, scene: Scene) -> Float[Array, "*batch y x"]:
    """The noise-free capture: planes mixed, convolved with the planned PSFs, and added up."""
    _require_same_scene(plan, scene)
    _require_like_camera(plan, camera)
    own = precision_of(camera.sensor.pitch)
    images = [p.image.shape[:-2] for p in scene.planes]
    check_memory(camera.sensor, plan.field_shape, images[0])
    with allow(plan.precision, camera, scene):
        camera, scene = cast((camera, scene), plan.precision)
        fields = jnp.stack([project(camera, p, plan.field_shape) for p in scene.planes])
        mixed = jnp.tensordot(jnp.asarray(plan.mixing, fields.dtype), fields, axes=1)
        light = tuple(zip(plan.wavelengths, plan.weights, strict=True))
        grid = kernel_grid(camera.sensor.grid, plan.field_shape)
        total = jnp.zeros((), fields.dtype)
        for distance, field in zip(plan.distances, mixed, strict=True):
            kernel = spectral_psf(
                camera,
                light,
                distance,
                model=plan.model,
                pixel_integration=plan.pixel_integration,
                grid=grid,
            )
            shapes = camera.sensor.shape, plan.field_shape
            total = total + CropConvolution(kernel, grid.pitch, *shapes)(field)
    return cast(total, own)


def _require_like_camera(plan: Plan, camera: LenslessCamera) -> None:
    """The plan's, or one near it: as in a search, whose numbers may be traced."""
    own = plan.camera
    pairs: dict[str, tuple[object, object]] = {
        "mask": (type(own.mask), type(camera.mask)),
        "sensor.shape": (own.sensor.shape, camera.sensor.shape),
    }
    numbers = {
        "sensor.pitch": (own.sensor.pitch, camera.sensor.pitch),
        "distance": (own.distance, camera.distance),
        "mask.extent": (own.mask.extent[0], camera.mask.extent[0]),
        "mask.beta": (getattr(own.mask, "beta", 0.0), getattr(camera.mask, "beta", 0.0)),
    }
    other = [name for name, (first, second) in pairs.items() if first != second]
    other += [
        name
        for name, (first, second) in numbers.items()
        if not _checks.is_traced(second)
        and not np.isclose(float(first), float(second), rtol=_NEAR, atol=0.0)
    ]
    if other:
        raise ValueError(
            f"the plan is for another camera ({', '.join(other)} differ): make a plan for this one"
        )


def _require_same_scene(plan: Plan, scene: Scene) -> None:
    distances = [p.distance for p in scene.planes]
    if len(distances) != len(plan.scene_distances) or not np.allclose(
        np.asarray(distances, float), plan.scene_distances, rtol=1e-6
    ):
        raise ValueError(
            f"the plan is for {len(plan.scene_distances)} planes at given distances, the scene has "
            "others: make a plan for it"
        )
    wavelengths = np.asarray(scene.spectrum.wavelengths, float)
    if len(wavelengths) != len(plan.scene_wavelengths) or not np.allclose(
        wavelengths, plan.scene_wavelengths, rtol=1e-6
    ):
        raise ValueError(
            f"the plan is for {len(plan.scene_wavelengths)} given wavelengths, the scene has "
            "others: make a plan for it"
        )
