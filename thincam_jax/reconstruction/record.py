"""Simulated recordings: captures of a scene, with the imaging model that it has."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import Grid
from thincam_jax._core.progress import watched
from thincam_jax._core.random import random_key
from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import AbstractNoise, GaussianNoise, read_out
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
    camera: Any,
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
      frame is split; or a `waveguide.SeeThroughCamera`, before whose middle pixel's view the scene
      has its middle. Its film chooses the colour, whatever the scene's light.
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
    if isinstance(noise, float | int):
        if noise <= 0:
            raise ValueError(
                f"noise = {noise:g} dB is as much noise as light, or more; give None for none, or "
                f"tc.GaussianNoise({noise:g}) for so much"
            )
        noise = GaussianNoise(noise)
    if not isinstance(camera, LenslessCamera | Mosaic | Sequence):
        if model != "separable":
            raise TypeError(f"model = {checks.shown(model)} is of a mask's PSF; leave it out here")
        return _behind_a_screen(camera, scene, noise, random_key(key))
    exposed: list[Any] = [camera] if isinstance(camera, LenslessCamera | Mosaic) else list(camera)
    cameras: list[LenslessCamera] = list(camera.cameras) if isinstance(camera, Mosaic) else exposed
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
    variances = _variances(noise, frames)
    if isinstance(camera, Mosaic):
        frames = camera.split(frames[0])
        variances = variances and variances * len(frames)
    if not checks.holds_traced(scene, cameras):
        covers = [projected_shape(c, plane) for c in cameras for plane in scene.planes]
        widest = np.minimum(in_steps(np.max(covers, axis=0).tolist()), optics.seen_field)
        optics = optics.replace(field_shape=tuple(int(n) for n in widest), whole_scene=True)
    return Recording(frames, optics, noise_variance=variances)


def _variances(noise: AbstractNoise | None, frames: Sequence[Any]) -> list[float] | None:
    if not isinstance(noise, GaussianNoise) or checks.holds_traced(frames):
        return None
    return [float(np.mean(np.asarray(noise.variance(one)))) for one in frames]


def _behind_a_screen(camera: Any, scene: Scene, noise: AbstractNoise | None, key: Any) -> Recording:
    """A recording of as many cells in each plane, at most as large as what a pixel sees."""
    from thincam_jax import waveguide as wg
    from thincam_jax.waveguide.camera import seen_size

    if not isinstance(camera, wg.SeeThroughCamera):
        raise TypeError(
            f"camera is {checks.shown(camera)}; give a LenslessCamera, several, a Mosaic, or a "
            "waveguide.SeeThroughCamera"
        )
    wg.check_screen(camera)
    middles = [
        wg.trace(camera, np.zeros((1, 2)), object_distance=one.distance, orders=1).points[0, 0]
        for one in scene.planes
    ]
    whole = [
        wg.ObjectPlane((1, 1), one.distance, one.width, middle[1::-1])
        for one, middle in zip(scene.planes, middles, strict=True)
    ]
    columns = max(math.ceil(float(one.width / seen_size(camera, one))) for one in whole)
    rows = max(math.ceil(float(one.height / one.width) * columns) for one in scene.planes)
    planes = [one.replace(shape=(rows, columns)) for one in whole]
    images = [
        one.sample(Grid((rows, columns), cells.pitch), magnification=1.0)
        for one, cells in zip(scene.planes, planes, strict=True)
    ]
    operator = wg.system_operator(camera, planes if len(planes) > 1 else planes[0])
    image = jnp.stack(images, axis=-3) if len(planes) > 1 else images[0]
    frame = read_out(camera.sensor, operator(image), noise=noise, key=key)
    return Recording([frame], [operator], noise_variance=_variances(noise, [frame]))
