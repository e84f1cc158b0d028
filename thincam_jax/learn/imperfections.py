"""Simulated captures with the faults of real cameras, for training without a real capture.

A network that learns from perfect simulations fails at the first real capture: its PSF is not
quite that of the file, and the sensor adds what no model has. Each capture is therefore drawn
with faults of its own, which the reconstruction does not know.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import FieldError, check_fields, quantity, whole
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.psf_check import resampled

_SHARE = Annotated[float, quantity("parts of one", least=0.0, most=1.0)]


@checked
@dataclass(frozen=True)
class Imperfections:
    """Largest faults of a capture; each capture draws its own, uniformly up to these.

    - `scale`, `turn`, `blur`: the true PSF is larger or smaller by this part, turned by so many
      degrees, either way, and wider by a Gaussian of this standard deviation in pixels.
    - `background`, `ambient`: uniform light, and light that changes smoothly over the sensor, in
      parts of the capture's largest value.
    - `saturated`: share of the pixels that are saturated, in a half of the captures.
    - `hot`: share of hot pixels.
    - `electrons`: fewest and most electrons of a full pixel, drawn by their logarithm; `read`:
      read noise, electrons.
    - `bits`: fewest bits; up to 12 are drawn.

    **Errors**: ValueError for numbers out of range.
    """

    scale: Annotated[float, quantity("parts of one", least=0.0, most=0.2)] = 0.02
    turn: Annotated[float, quantity("degrees", least=0.0, most=45.0)] = 0.5
    blur: Annotated[float, quantity("pixels", least=0.0, most=20.0)] = 1.0
    background: _SHARE = 0.1
    ambient: _SHARE = 0.05
    saturated: _SHARE = 0.005
    hot: _SHARE = 1e-4
    electrons: Annotated[tuple[float, float], quantity("electrons", positive=True, many=True)] = (
        1000.0,
        20000.0,
    )
    read: Annotated[float, quantity("electrons", least=0.0, most=1e6)] = 4.0
    bits: Annotated[int, whole(4, 12)] = 8

    def __post_init__(self):
        check_fields(self)
        if self.electrons[0] > self.electrons[1]:
            raise FieldError(f"electrons = {self.electrons}: give the fewest first", "electrons")

    def without(self, name: str) -> "Imperfections":
        """These without one of them: no fault of a PSF, no light, or 12 bits."""
        return dataclasses.replace(self, **{name: 12 if name == "bits" else 0.0})

    def psf(
        self, psf: Float[np.ndarray, "*batch k l"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "*batch k l"]:
        """A true PSF, of which the one given is a wrong measurement; with the same sum."""
        scale = 1 + self.scale * rng.uniform(-1, 1)
        angle = math.radians(self.turn * rng.uniform(-1, 1))
        blur = self.blur * rng.uniform()
        rotation = np.array(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )
        planes = psf.reshape(-1, *psf.shape[-2:]).astype(float)
        changed = np.maximum(resampled(planes, rotation / scale), 0)
        changed = np.stack([ndimage.gaussian_filter(one, blur) for one in changed])
        sums = changed.sum(axis=(1, 2), keepdims=True)
        changed *= planes.sum(axis=(1, 2), keepdims=True) / np.where(sums > 0, sums, 1)
        return changed.reshape(psf.shape).astype(np.float32)

    def capture(
        self,
        operator: CropConvolution,
        psf: Float[np.ndarray, "colour k l"],
        scene: Float[np.ndarray, "channel m n"],
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "channel y x"]:
        """Capture of a scene with drawn faults, in the unit of `psf` times `scene`.

        - `operator`: model of the camera, for its shapes; `psf`: measured PSF.
        """
        kernel = jnp.asarray(self.psf(psf, rng)[:, None])
        shapes = operator.sensor_shape, operator.field_shape
        true = CropConvolution(kernel, 1.0, *shapes, summed=1, window=operator.window)
        light = np.asarray(true(jnp.asarray(scene, kernel.dtype)[:, None]))
        return self.exposed(light, rng)

    def exposed(
        self, light: Float[np.ndarray, "channel y x"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "channel y x"]:
        """Capture of light by a sensor: background, saturation, noise and quantisation."""
        largest = max(float(light.max()), 1e-12)
        light = light + largest * self.background * rng.uniform()
        smooth = rng.uniform(0, 1, (len(light), 2, 3))
        zoom = [1, *(n / m for n, m in zip(light.shape[1:], smooth.shape[1:], strict=True))]
        smooth = ndimage.zoom(smooth, zoom, order=1, grid_mode=True, mode="nearest")
        light = light + largest * self.ambient * rng.uniform() * smooth
        share = self.saturated * rng.uniform() * (rng.random() < 0.5)
        full = max(float(np.quantile(light, 1 - share)), 1e-12)
        full *= 1.0 if share > 0 else 1 / rng.uniform(0.5, 0.98)
        electrons = math.exp(rng.uniform(*np.log(self.electrons)))
        counted = rng.poisson(np.maximum(light, 0) * (electrons / full))
        counted = counted + self.read * rng.standard_normal(light.shape)
        hot = rng.random(light.shape[1:]) < self.hot
        counted[:, hot] = electrons * rng.uniform(0.5, 1, int(hot.sum()))
        # A black level keeps the noise of dark pixels; it is known, and subtracted.
        most = 2 ** int(rng.integers(self.bits, 13)) - 1
        black = 0.02
        codes = np.round(np.clip((1 - black) * counted / electrons + black, 0, 1) * most)
        return (full * (codes / most - black) / (1 - black)).astype(np.float32)
