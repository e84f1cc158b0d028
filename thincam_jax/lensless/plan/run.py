"""Carrying out a plan."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import allow, cast, precision_of
from thincam_jax.imaging.operators import CropConvolution, kernel_grid
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.exposure import project, spectral_psf
from thincam_jax.lensless.plan.fits import require_fits
from thincam_jax.lensless.plan.records import Plan


def run_plan(plan: Plan, camera: LenslessCamera, scene: Scene) -> Float[Array, "*batch y x"]:
    """The noise-free capture: planes mixed, convolved with the planned PSFs, and added up."""
    require_fits(plan, camera, scene)
    own = precision_of(camera.sensor.pitch)
    rows, columns = camera.sensor.shape
    refuse_if_too_large(
        f"the planned capture of {rows}×{columns} pixels",
        plan.cost.bytes,
        "use a smaller sensor, a smaller scene, or fewer images at a time",
    )
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
