"""Simulated recordings: captures of a scene, with the imaging model that it has."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.progress import watched
from thincam_jax._core.random import random_key
from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import AbstractNoise, GaussianNoise
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.capture import capture
from thincam_jax.lensless.forward import in_steps, projected_shape
from thincam_jax.lensless.method import Model, PsfMethod
from thincam_jax.lensless.mosaic import Mosaic
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.recording import Recording


@checked
@watched("recording")
def record(
    camera: LenslessCamera | Mosaic | Sequence[LenslessCamera],
    scene: Scene,
    *,
    noise: AbstractNoise | float | int | None = None,
    key: Any = 0,
    model: Model | PsfMethod = "separable",
) -> Recording:
    """Capture a scene by one camera or several, with all that its reconstruction needs.

    The recording has the scene's light and distances, and the field that its planes fill, as far
    as the sensor sees it: up to an eighth more, in steps, so that another distance seldom compiles.

    **Arguments**

    - `camera`: one, or one for each capture: phases, pitches, distances; or a `Mosaic`, whose one
      frame is split.
    - `noise`: its signal-to-noise ratio in dB (`GaussianNoise`), or a noise; None for none.
    - `key`: seed of the noise, or a key; each capture has a noise of its own.
    - `model`: PSF model of captures and reconstruction, see `psf`.

    **Returns** a `Recording` for `reconstruct`. `capture` gives the array alone.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 550e-6)
    result = tc.reconstruct(tc.record(camera, scene, noise=30.0))
    ```

    **See also**: `capture`, `Recording`, `Scene.photograph`.
    """
    exposed: list[Any] = [camera] if isinstance(camera, LenslessCamera | Mosaic) else list(camera)
    cameras: list[LenslessCamera] = list(camera.cameras) if isinstance(camera, Mosaic) else exposed
    noise = GaussianNoise(noise) if isinstance(noise, float | int) else noise
    distances = [plane.distance for plane in scene.planes]
    light = scene.spectrum
    optics = Cameras(
        cameras,
        wavelength=light if light.wavelengths.size > 1 else checks.each(light.wavelengths)[0],
        object_distance=distances[0] if len(distances) == 1 else np.unique(distances),
        model=model,
    )
    key = random_key(key)
    keys = [key] if len(exposed) == 1 else jax.random.split(key, len(exposed))
    frames = [
        capture(one, scene, noise=noise, key=k, model=model)
        for one, k in zip(exposed, keys, strict=True)
    ]
    variances = None
    if isinstance(noise, GaussianNoise) and not checks.holds_traced(frames):
        variances = [float(np.mean(np.asarray(noise.variance(one)))) for one in frames]
    if isinstance(camera, Mosaic):
        frames = camera.split(frames[0])
        variances = variances and variances * len(frames)
    if not checks.holds_traced(scene, cameras):
        covers = [projected_shape(c, plane) for c in cameras for plane in scene.planes]
        widest = np.minimum(in_steps(np.max(covers, axis=0).tolist()), optics.seen_field)
        optics = optics.replace(field_shape=tuple(int(n) for n in widest), whole_scene=True)
    return Recording(frames, optics, noise_variance=variances)
