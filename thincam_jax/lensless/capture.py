"""Captures of a scene by a camera."""

import functools
import operator
import warnings
from typing import Any

from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.progress import watched
from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import AbstractNoise, read_out
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.forward import expose
from thincam_jax.lensless.method import AccuracyWarning, Model, PsfMethod, as_method
from thincam_jax.lensless.mosaic import Mosaic
from thincam_jax.lensless.plan.run import CapturePlan, run_plan
from thincam_jax.lensless.resolve import SamplingWarning, warn_if_unresolved

# Pixels that an image is cast on, at fewer of which one of so many rows and columns is not seen.
_TINY, _PICTURE = 2.0, 8
_HUGE, _LARGEST = 100.0, 500.0  # times the sensor, and mm, that a mask in other units is wide
_ON_AXIS = (
    "the sensor's angular_response is left out: every point has the light of the axis; give "
    "model=PsfMethod(field_tolerance=1.0)"
)


@checked
@watched("capturing")
def capture(
    camera: LenslessCamera | Mosaic,
    scene: Scene,
    *,
    key: Any = None,
    noise: AbstractNoise | None = None,
    model: Model | PsfMethod | CapturePlan = "separable",
    pixel_integration: bool | None = None,
) -> Float[Array, "*batch y x"]:
    r"""The captured image of a scene (thesis Eq 3.8): Σ over planes and wavelengths of h ∗ f_d.

    Each plane at t appears on the sensor turned by 180° and scaled by d/t (Eq 3.6, corrected), is
    convolved with the PSF of its distance and light, and cropped to the sensor. The
    convolution is linear: nothing wraps round, and light that falls beside the sensor is lost. The
    PSF and the light are those of the axis everywhere: of the thesis' zone aperture (β = 25
    rad/mm², 5.6 mm wide, at 6.5 mm) the PSF is 7 % off at 10° and 26 % at 20°, the light 6 and 22
    %. `PsfMethod(field_tolerance=0.01)` gives every point its own (`field_operator`).

    **Arguments**

    - `camera`: a camera, or a `Mosaic` of several on one sensor.
    - `scene`: planes with a common batch shape; the batch is captured image by image.
    - `noise`, `key`: see `thincam_jax.imaging.sensor`; without noise the result is deterministic.
    - `model`: PSF model or `PsfMethod`, see `psf`; or what `plan_capture` returns.
    - `pixel_integration`: average the PSF over the pixels, as a real sensor does; by default yes,
      or as planned.

    **Returns** (*batch, y, x) in units of radiance × mm². Warns (`SamplingWarning`) where the
    mask's shadow is finer than the pixels resolve.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    noisy = tc.capture(camera, scene, noise=tc.GaussianNoise(snr_db=30.0), key=0)
    print(noisy.shape)  # (24, 32)
    ```

    **See also**: `Scene`, `plan_capture`, `reconstruct`.
    """
    if isinstance(camera, Mosaic) and camera.wall is not None:
        parts = [_light(part, scene, model, pixel_integration) for part in camera.cameras]
        image = camera.join(parts)
    else:
        whole = camera.whole if isinstance(camera, Mosaic) else camera
        image = _light(whole, scene, model, pixel_integration)
    return read_out(camera.sensor, image, noise=noise, key=key)


def _warn_of_units(camera: LenslessCamera, scene: Scene) -> None:
    """SamplingWarning, at the caller's caller, for sizes that are none in mm."""
    if checks.holds_traced(camera, scene):
        return
    mask = float(max(camera.mask.extent))
    sensor = max(camera.sensor.shape) * float(camera.sensor.pitch)
    if mask > max(_HUGE * sensor, _LARGEST):
        warnings.warn(
            f"the mask is {mask:.3g} mm wide, {mask / sensor:.0f} times the sensor, which sees "
            "nothing of its structure; give lengths in mm",
            SamplingWarning,
            stacklevel=4,
        )
    warn_if_unseen(scene, float(camera.distance), float(camera.sensor.pitch), level=5)


def warn_if_unseen(scene: Scene, distance: float, pitch: float, level: int = 3) -> None:
    """SamplingWarning for pictures that a mask casts on less than a pixel.

    - `distance`, `pitch`: distance of the mask and pitch of the pixels, mm.
    """
    for plane in scene.planes:
        far, width = float(plane.distance), float(plane.width)
        cast = width * distance / far / pitch
        if cast < _TINY and min(plane.image.shape[-2:]) >= _PICTURE:
            warnings.warn(
                f"the scene, {width:g} mm wide at {far:g} mm, is cast {cast:.2g} pixels wide by a "
                f"mask at {distance:g} mm: none of it is seen; give lengths in mm, or a wider "
                "scene",
                SamplingWarning,
                stacklevel=level,
            )


def _light(
    camera: LenslessCamera,
    scene: Scene,
    model: Model | PsfMethod | CapturePlan,
    pixel_integration: bool | None,
) -> Float[Array, "*batch y x"]:
    """The noise-free image."""
    warn_if_unresolved(camera, (plane.distance for plane in scene.planes))
    _warn_of_units(camera, scene)
    if isinstance(model, CapturePlan):
        if pixel_integration is not None:
            raise ValueError("a plan chooses pixel_integration: leave it out")
        return run_plan(model, camera, scene)
    how = as_method(model, pixel_integration is not False)
    if camera.sensor.angular_response is not None and how.field_tolerance is None:
        warnings.warn(_ON_AXIS, AccuracyWarning, stacklevel=4)
    planes = (expose(camera, plane, scene.spectrum.colours, how) for plane in scene.planes)
    return functools.reduce(operator.add, planes)
