"""From a scene to what the camera captures."""

import functools
import operator
from typing import Any

from jaxtyping import Array, Float

from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import AbstractNoise, read_out
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.forward import expose
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.plan import Plan, run_plan
from thincam_jax.lensless.sampling import warn_if_unresolved


def capture(
    camera: LenslessCamera,
    scene: Any,
    *,
    key: Any = None,
    noise: AbstractNoise | None = None,
    model: Model | None = None,
    pixel_integration: bool | None = None,
    plan: Plan | None = None,
) -> Float[Array, "*batch y x"]:
    r"""The captured image of a scene (thesis Eq 3.8): Σ over planes and wavelengths of h ∗ f_d.

    Each plane at t appears on the sensor turned by 180° and scaled by d/t (Eq 3.6, corrected), is
    convolved with the PSF of its distance and light, and cropped to the sensor. The
    convolution is linear: nothing wraps round, and light that falls beside the sensor is lost. The
    PSF is shift-invariant: obliquity and vignetting are left out, which is right to a few per cent
    for fields under some 20° from the axis.

    **Arguments**

    - `scene`: planes with a common batch shape; the batch is captured image by image.
    - `noise`, `key`: see `thincam_jax.imaging.sensor`; without noise the result is deterministic.
    - `model`: PSF model, see `psf`; "separable" by default.
    - `pixel_integration`: average the PSF over the pixels, as a real sensor does; by default yes.
    - `plan`: from `thincam_jax.plan`; says how to compute in place of the two before.

    **Returns** (*batch, y, x) in units of radiance × mm². Warns (`SamplingWarning`) where the
    mask's shadow is finer than the pixels resolve.
    """
    if not isinstance(scene, Scene):
        raise TypeError(
            f"scene is a {type(scene).__name__}; give thincam_jax.Scene(ImagePlane(image, "
            "distance=…, width=…), wavelength)"
        )
    warn_if_unresolved(camera, (plane.distance for plane in scene.planes))
    if plan is not None:
        if model is not None or pixel_integration is not None:
            raise ValueError("a plan chooses model and pixel_integration: leave them out")
        if not isinstance(plan, Plan):
            raise TypeError(f"plan is a {type(plan).__name__}; give what thincam_jax.plan returns")
        image = run_plan(plan, camera, scene)
    else:
        whole = True if pixel_integration is None else pixel_integration
        parts = (
            expose(
                camera, plane, scene.spectrum, model=model or "separable", pixel_integration=whole
            )
            for plane in scene.planes
        )
        image = functools.reduce(operator.add, parts)
    return read_out(camera.sensor, image, noise=noise, key=key)
