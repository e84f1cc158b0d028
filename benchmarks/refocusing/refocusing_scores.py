"""Scenes to judge a refocusing network by, and how far an image is from them."""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import skimage.measure
from jaxtyping import Array, ArrayLike, Bool, Float, Num, PRNGKeyArray
from scipy import ndimage
from skimage.metrics import structural_similarity

from thincam_jax.imaging.metrics import align, psnr, ssim
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.sensor import AbstractNoise
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.scenes import LAYERS, PARTS, LayeredScene, captured


def flat_scene(
    camera: RefocusCamera,
    pictures: Sequence[Num[ArrayLike, "y x"]],
    covers: Sequence[Num[ArrayLike, "y x"]],
    distances: Sequence[float | int],
) -> LayeredScene:
    """Flat layers from the front to the back.

    **Arguments**, up to three of each: `pictures` (y, x), radiance; `covers` (y, x), 0 to 1, that
    of the last usually 1 everywhere; `distances`, mm.
    """
    missing = LAYERS - len(distances)
    if missing < 0 or not len(pictures) == len(covers) == len(distances) > 0:
        raise ValueError(
            f"{len(pictures)} pictures, {len(covers)} covers, {len(distances)} distances; give one "
            f"to {LAYERS} of each"
        )
    dtype, shape = camera.near.dtype, camera.field_shape
    nothing = [np.zeros(shape)] * missing
    inverse = 1 / np.asarray([*[distances[0]] * missing, *distances], float)
    return LayeredScene(
        jnp.asarray(np.stack([*nothing, *pictures]), dtype),
        jnp.asarray(np.stack([*nothing, *covers]), dtype),
        jnp.zeros((LAYERS, PARTS, *shape), dtype).at[:, PARTS // 2].set(1),
        jnp.asarray(np.repeat(inverse[:, None], PARTS, axis=1), dtype),
    )


def capture_scene(
    camera: RefocusCamera, scene: LayeredScene, noise: AbstractNoise, key: PRNGKeyArray
) -> tuple[Float[Array, "y x"], Float[Array, ""]]:
    """The capture of a scene, and the root mean square of its noise."""
    return with_noise(captured(camera, scene.emission(camera), scene.inverse), noise, key)


def with_noise(
    clean: Float[Array, "y x"],
    noise: AbstractNoise,
    key: PRNGKeyArray,
    electrons: float | Float[Array, ""] | None = None,
):
    """A noise-free capture with noise, and the noise's root mean square.

    `electrons`: mean number per pixel, for shot noise.
    """
    counted = None if electrons is None else (electrons / jnp.mean(clean)).reshape(1, 1)
    deviation = jnp.sqrt(noise.variance(clean, counted))
    return noise.add(key, clean, counted), deviation


def sub_aperture_capture(
    camera: RefocusCamera, scene: LayeredScene, cells: int = 5
) -> Float[Array, "y x"]:
    """The noise-free capture of flat layers, each part of the mask with its own view.

    Of the light of a point on the axis, what falls on the sensor's point Mm has come through the
    mask at m. The PSF is cut into cells × cells parts accordingly. From m a layer in front stands
    elsewhere before one behind: moved by d·m(1/t_front − 1/t_back) in the image. What it hides is
    found for each cell, where a `LayeredScene` takes the mean over the mask.
    """
    thin = camera.camera
    shape, pitch = camera.field_shape, float(thin.sensor.pitch)
    inverse = np.asarray(scene.inverse[:, PARTS // 2], float)
    light = np.asarray(scene.radiance * scene.cover, float)
    cover = np.asarray(scene.cover, float)
    kernels = np.asarray(camera.kernels(jnp.asarray(1 / inverse)))
    distance = float(thin.distance)
    total = jnp.zeros(thin.sensor.shape, camera.near.dtype)
    for layer, nearer in enumerate(inverse):
        if not light[layer].any():
            continue
        scale = 1 + distance * nearer  # the shadow's
        sides = [float(side) * scale for side in thin.mask.extent]
        edges = [
            _edges(n, pitch, side, cells) for n, side in zip(camera.support, sides, strict=True)
        ]
        for row, column in itertools.product(range(cells), repeat=2):
            part = np.zeros(camera.support)
            where = np.ix_(edges[0] == row, edges[1] == column)
            part[where] = kernels[layer][where]
            middles = [(n + 0.5 - cells / 2) / cells for n in (row, column)]
            at = [m * float(side) for m, side in zip(middles, thin.mask.extent, strict=True)]
            seen = light[layer]
            for front in range(layer):
                move = [distance * m * (inverse[front] - nearer) / pitch for m in at]
                hidden = ndimage.shift(cover[front], move, order=1, mode="nearest")
                seen = seen * (1 - hidden)
            operator = CropConvolution(
                jnp.asarray(part, camera.near.dtype), pitch, thin.sensor.shape, shape
            )
            total = total + operator(jnp.asarray(seen, camera.near.dtype))
    return total


def _edges(count: int, pitch: float, side: float, cells: int) -> np.ndarray:
    """The cell of each sample along an axis; the outermost take what is beyond the shadow."""
    x = (np.arange(count) - (count - 1) / 2) * pitch
    return np.clip(np.floor((x / side + 0.5) * cells), 0, cells - 1).astype(int)


def scores(
    image: Num[ArrayLike, "y x"],
    target: Num[ArrayLike, "y x"],
    region: Bool[ArrayLike, "y x"] | None = None,
) -> dict[str, float]:
    """PSNR, SSIM and MS-SSIM of an image, aligned to the target, whose peak is 1, by a line.

    `region`: where to take the PSNR, (y, x) booleans; the others are of the whole image.
    """
    peak = max(float(np.max(target)), 1e-9)
    image, target = np.asarray(image, float) / peak, np.asarray(target, float) / peak
    inside = np.ones(target.shape, bool) if region is None else np.asarray(region)
    return {
        "psnr": psnr(image[inside][:, None], target[inside][:, None]),
        "ssim": ssim(image, target),
        "ms_ssim": multiscale_ssim(align(image, target), target),
    }


# Exponents of the scales from the finest (Wang, Simoncelli and Bovik, Asilomar 2003, section 3.2).
_SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def multiscale_ssim(image: np.ndarray, target: np.ndarray) -> float:
    """Multi-scale structural similarity (Wang et al. 2003), peak 1, Gaussian windows of 1.5 pixels.

    Contrast and structure at every scale, luminance at the coarsest. Images too small for five
    scales of the window's 11 pixels have fewer, whose exponents then sum to 1 again.
    """
    count = min(len(_SCALES), int(np.log2(min(image.shape) / 11)) + 1)
    exponents = np.asarray(_SCALES[:count]) / sum(_SCALES[:count])
    small, found = 0.01**2, 1.0
    options = {"gaussian_weights": True, "use_sample_covariance": False, "data_range": 1.0}
    for scale, exponent in enumerate(exponents):
        if scale:
            image, target = (skimage.measure.block_reduce(x, 2, np.mean) for x in (image, target))
        similarity = structural_similarity(target, image, full=True, **options)[1]
        if scale < count - 1:
            a, b = (ndimage.gaussian_filter(x, 1.5, truncate=3.5) for x in (image, target))
            similarity = similarity * (a**2 + b**2 + small) / (2 * a * b + small)
        found *= max(float(np.mean(similarity[5:-5, 5:-5])), 0.0) ** exponent
    return found
