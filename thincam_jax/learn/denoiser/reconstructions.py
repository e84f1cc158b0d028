"""Lessons of reconstruction: a denoiser learns inside plug and play, behind drawn cameras.

What a data step leaves is not white: it has the noise of some frequencies, and the errors that the
denoiser made before at those that the camera hardly shows. The whole course of `PlugAndPlay` is
therefore differentiated, data steps by the implicit function theorem (Zhang, van Gool, Timofte,
USRNet, CVPR 2020, learn so behind blurs). No camera of a user is among those drawn.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, PRNGKeyArray
from scipy import ndimage

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.learn import plug_and_play
from thincam_jax.learn.denoiser.network import LEAST, MOST, DenoisingUNet, denoised
from thincam_jax.reconstruction.normal_equations import normal_equations
from thincam_jax.reconstruction.problem import InverseProblem, back_projected, uniform_image

# ln of the exponents and factors that change the contrast of a crop.
_GAMMA, _GAIN = (-0.9, 0.3), (-0.8, 0.5)
# Standard deviation of an offset subtracted from a crop beside its mean: in a large image, local
# means differ from the mean of the whole.
_OFFSET = 0.15
# Added to MSE/σ²: the root's slope stays finite.
_LEAST_ERROR = 1e-4


class Crops(eqx.Module):
    """Noisy crops and what is to be found in them; see `denoised` for `centre`."""

    clean: Float[Array, "image y x"]
    noisy: Float[Array, "image y x"]
    sigma: Float[Array, " image"]
    centre: Float[Array, " image"]


@eqx.filter_jit
def draw_crops(
    tiles: Float[Array, "tile side side 3"], batch: int, crop: int, key: PRNGKeyArray
) -> Crops:
    """Crops of tiles, turned and mirrored, in changed contrast, with noise of all levels.

    Grey is a random mixture of the three colours. Half of the crops are linear light, the others
    powers of it. ln σ is uniform, stratified over the batch.
    """
    keys = iter(jax.random.split(key, 12))
    count, side = tiles.shape[:2]
    chosen = jax.random.randint(next(keys), (batch,), 0, count)
    corner = jax.random.randint(next(keys), (batch, 2), 0, side - crop + 1)

    def cut(tile, place):
        return jax.lax.dynamic_slice(tiles, (tile, *place, 0), (1, crop, crop, 3))[0]

    mixture = jax.random.dirichlet(next(keys), jnp.ones(3, tiles.dtype), (batch,), tiles.dtype)
    clean = jnp.einsum("byxc,bc->byx", jax.vmap(cut)(chosen, corner), mixture, precision="highest")
    turned = jax.random.bernoulli(next(keys), shape=(3, batch, 1, 1))
    clean = jnp.where(turned[0], clean[:, ::-1], clean)
    clean = jnp.where(turned[1], clean[:, :, ::-1], clean)
    clean = jnp.where(turned[2], jnp.swapaxes(clean, 1, 2), clean)

    def uniform(low: float, high: float):
        return jax.random.uniform(next(keys), (batch, 1, 1), tiles.dtype, low, high)

    is_linear = jax.random.bernoulli(next(keys), shape=(batch, 1, 1))
    # A power below 1 has no finite slope at 0, which nothing is differentiated by here.
    power = jnp.where(is_linear, jnp.ones((), tiles.dtype), jnp.exp(uniform(*_GAMMA)))
    clean = clean**power * jnp.exp(uniform(*_GAIN))
    strata = jnp.arange(batch, dtype=tiles.dtype) + uniform(0.0, 1.0)[:, 0, 0]
    spread = math.log(MOST / LEAST) / batch
    sigma = LEAST * jnp.exp(spread * strata)
    noise = jax.random.normal(next(keys), clean.shape, tiles.dtype)
    noisy = clean + sigma[:, None, None] * noise
    offset = _OFFSET * jax.random.normal(next(keys), (batch,), tiles.dtype)
    return Crops(clean, noisy, sigma, jnp.mean(noisy, axis=(1, 2)) + offset)


def loss(network: DenoisingUNet, crops: Crops) -> tuple[Array, dict[str, Array]]:
    """Mean of RMSE/√σ: what good denoisers leave grows about as √σ, so all levels weigh the same.

    A logarithm of the error would weigh flat crops as much as those with detail.
    """
    found = denoised(network, crops.noisy, crops.sigma, crops.centre)
    error = jnp.mean((found - crops.clean) ** 2, axis=(1, 2)) / crops.sigma**2
    value = jnp.mean(jnp.sqrt((error + _LEAST_ERROR) * crops.sigma))
    return value, {"error": jnp.mean(error)}


_FINER = 3  # samples of a shadow along a side of a pixel
_ORDERS = (17, 31, 43, 61, 73, 101)  # of uniformly redundant arrays


def drawn_kernels(
    rng: np.random.Generator, side: int, width: float, captures: int
) -> Float32[np.ndarray, "capture side side"]:
    """PSFs of one camera on a grid of `side` pixels, whose mask's shadow is some `width` wide.

    Six of ten single captures are of zone plates, two of uniformly redundant arrays, the others
    of random cells, diffusers or lenslets. Several are of zone plates in other phases, or of two
    plates or distances in two phases each. Their response to any frequency is at most 1 in all.
    """
    if captures > 1:
        kernels = _stack_of_zones(rng, side, width, captures)
    else:
        kinds = [_zones] * 6 + [_uniformly_redundant] * 2 + [_cells, _diffuser, _lenslets]
        draw: Callable[..., np.ndarray] = kinds[rng.integers(len(kinds))]
        kernels = draw(rng, side, width)[None]
    blur = rng.uniform(0, 0.9)  # of diffraction and the pixels
    kernels = np.stack([ndimage.gaussian_filter(kernel, blur) for kernel in kernels])
    response = np.sum(np.abs(np.fft.rfft2(kernels)) ** 2, axis=0).max() ** 0.5
    return (kernels / response).astype(np.float32)


def _places(side: int) -> np.ndarray:
    count = side * _FINER
    return (np.arange(count) - (count - 1) / 2) / _FINER


def _on_pixels(shadow: np.ndarray) -> np.ndarray:
    side = len(shadow) // _FINER
    return shadow.reshape(side, _FINER, side, _FINER).mean(axis=(1, 3))


def _zone_rate(rng: np.random.Generator, width: float) -> float:
    """β of cos(βr²), so that zones at the edge have 0.1 to 0.5 cycles per pixel."""
    return np.pi * np.exp(rng.uniform(np.log(0.1), np.log(0.5))) / (width / 2)


def _zone_plate(side: int, width: float, rate: float, phase: float, *, binary: bool) -> np.ndarray:
    squared = _places(side)[:, None] ** 2 + _places(side) ** 2
    plate = (1 + np.cos(rate * squared + phase)) / 2
    plate = (plate > 0.5).astype(float) if binary else plate
    return _on_pixels(plate * (squared < (width / 2) ** 2))


def _zones(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    phase = rng.uniform(0, 2 * np.pi) if rng.random() < 0.5 else 0.0
    return _zone_plate(side, width, _zone_rate(rng, width), phase, binary=rng.random() < 0.3)


def _stack_of_zones(
    rng: np.random.Generator, side: int, width: float, captures: int
) -> list[np.ndarray]:
    first = rate, width = _zone_rate(rng, width), width
    second = rate * np.exp(rng.uniform(-0.4, 0.4)), width * np.exp(rng.uniform(-0.2, 0.2))
    settings = [first] * captures if rng.random() < 0.4 else [first, second] * (captures // 2)
    turn = 2 * np.pi / captures if settings[0] == settings[-1] else np.pi / captures
    return [
        _zone_plate(side, wide, of, number * turn, binary=False)
        for number, (of, wide) in enumerate(settings)
    ]


def _enlarged(side: int, width: float, pattern: np.ndarray) -> np.ndarray:
    """Cells of a pattern, each at least a pixel wide."""
    count = len(pattern)
    cell = np.floor(_places(side) / max(width / count, 1.0) + count / 2).astype(int)
    inside = (cell >= 0) & (cell < count)
    cell = np.clip(cell, 0, count - 1)
    return _on_pixels(pattern[np.ix_(cell, cell)] * np.outer(inside, inside))


def _uniformly_redundant(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    """Modified uniformly redundant array (Gottesman, Fenimore, Appl. Opt. 28, 4344, 1989)."""
    order = int(rng.choice(_ORDERS))
    sign = np.full(order, -1)
    sign[np.arange(1, order) ** 2 % order] = 1
    pattern = (np.outer(sign, sign) > 0).astype(float)
    pattern[0], pattern[1:, 0] = 0, 1
    return _enlarged(side, width, np.roll(pattern, (order // 2, order // 2), (0, 1)))


def _cells(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    count = int(rng.integers(16, 120))
    is_open = rng.random((count, count)) < rng.uniform(0.15, 0.6)
    return _enlarged(side, width, is_open.astype(float))


def _diffuser(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    """Caustics: each ray is turned by the slope of a smooth relief."""
    count = int(width)
    squared = np.fft.fftfreq(count)[:, None] ** 2 + np.fft.fftfreq(count) ** 2
    smooth = np.exp(-rng.uniform(100, 1500) * squared)
    relief = np.fft.ifft2(np.fft.fft2(rng.standard_normal((count, count))) * smooth).real
    turn = np.exp(rng.uniform(np.log(8), np.log(60))) / relief.std()
    y, x = (np.indices((count, count))[k] + turn * np.gradient(relief, axis=k) for k in (0, 1))
    edges = np.arange(side + 1) - 0.5 - (side - count) / 2
    return np.histogram2d(y.ravel(), x.ravel(), [edges, edges])[0]


def _lenslets(rng: np.random.Generator, side: int, width: float) -> np.ndarray:
    image = np.zeros((side, side))
    middles = rng.uniform(-width, width, (int(rng.integers(8, 60)), 2)) / 2 + side / 2
    rows, columns = np.clip(middles, 0, side - 1).astype(int).T
    np.add.at(image, (rows, columns), rng.uniform(0.5, 1, len(rows)))
    return ndimage.gaussian_filter(image, rng.uniform(0.4, 1.5))


# Sides of the sensor in those of the field, and captures: half of the cameras are of the first.
_LAYOUTS = ((2, 1), (1, 1), (2, 1), (2, 4))
_SHADOW = (1.0, 2.0)  # width of masks' shadows, in sides of the field
# Noise in dB below a capture, or of so many electrons in its mean pixel, for a fifth of them.
_DECIBELS, _ELECTRONS, _SHOT = (14.0, 46.0), (50.0, 3000.0), 0.2
_PARTS = 3  # of a capture, along a side: the noise is that of the brightest
_WHITE = 0.4  # weight of denoising itself
_LEAST_ERROR, _DARK = 1e-6, 1e-3  # of MSE over the image's mean square, and added to that


class Reconstructions(eqx.Module):
    """Captures of crops by one camera; `crops` are also denoised by themselves."""

    crops: Crops
    problem: InverseProblem  # captures (image, channel, y, x)
    variance: Float[Array, " image"]


def draw_cameras(seed: int, count: int, side: int) -> list[list[CropConvolution]]:
    """Operators of the captures of each camera, for fields of `side` pixels."""
    cameras = []
    for number in range(count):
        sensor, captures = _LAYOUTS[number % len(_LAYOUTS)]
        rng, pixels = np.random.default_rng((seed, number)), sensor * side
        kernels = drawn_kernels(rng, pixels + side - 1, side * rng.uniform(*_SHADOW), captures)
        shapes = (pixels, pixels), (side, side)
        cameras.append([CropConvolution(jnp.asarray(k), 1.0, *shapes) for k in kernels])
    return cameras


def draw_reconstructions(
    cameras: list[list[CropConvolution]], tiles: Array, batch: int, crop: int, key: PRNGKeyArray
) -> Reconstructions:
    """Crops behind one of the cameras, with white noise, or that of electrons."""
    which, drawn, noise = jax.random.split(key, 3)
    camera = cameras[int(jax.random.randint(which, (), 0, len(cameras)))]
    return _captured(camera, draw_crops(tiles, batch, crop, drawn), noise)


@eqx.filter_jit
def _captured(camera: list[CropConvolution], crops: Crops, key: PRNGKeyArray) -> Reconstructions:
    count, dtype = len(crops.clean), crops.clean.dtype
    keys = jax.random.split(key, 3 + len(camera))

    def uniform(key, low: float, high: float):
        return jax.random.uniform(key, (count, 1, 1), dtype, low, high)

    share = 10 ** (-uniform(keys[0], *_DECIBELS) / 20)
    electrons = jnp.exp(uniform(keys[1], *np.log(_ELECTRONS).tolist()))
    is_shot = jax.random.bernoulli(keys[2], _SHOT, (count, 1, 1))
    captures, variances = [], []
    for operator, own in zip(camera, keys[3:], strict=True):
        capture = operator(crops.clean)
        mean = jnp.mean(capture, axis=(1, 2), keepdims=True)
        deviation = share * jnp.std(capture, axis=(1, 2), keepdims=True)
        variance = jnp.where(is_shot, jnp.maximum(capture, 0) * mean / electrons, deviation**2)
        variance = jnp.maximum(variance, 1e-10)
        noise = jnp.sqrt(variance) * jax.random.normal(own, capture.shape, dtype)
        captures.append((capture + noise)[:, None])
        rows, columns = (n // _PARTS for n in capture.shape[1:])
        parts = variance[:, : _PARTS * rows, : _PARTS * columns]
        parts = parts.reshape(count, _PARTS, rows, _PARTS, columns).mean(axis=(2, 4))
        variances.append(parts.max(axis=(1, 2)))
    variance = sum(variances[1:], start=variances[0]) / len(variances)
    return Reconstructions(crops, InverseProblem(camera, captures), variance)


def reconstructed(network: DenoisingUNet, lesson: Reconstructions) -> Float[Array, "image y x"]:
    """Images by the steps of `PlugAndPlay`, its noise known."""

    def one(captures: tuple[Array, ...], variance: Array) -> Array:
        problem = eqx.tree_at(lambda p: p.captures, lesson.problem, captures)
        return _reconstructed(network, problem, 1 / variance)

    return jax.vmap(one)(lesson.problem.captures, lesson.variance)


def _reconstructed(network: DenoisingUNet, problem: InverseProblem, precision: Array) -> Array:
    normal = normal_equations(problem, jnp.ones_like(precision))
    right, first = back_projected(problem, problem.captures), uniform_image(problem)

    def step(image: Array, s: Array) -> Array:
        shift = plug_and_play.shift_of(s, precision)
        found = plug_and_play.data_step(normal, right, image, shift, precision)
        sigma = plug_and_play.largest_noise(normal, shift, precision)
        flat = found.reshape(-1, *found.shape[-2:])
        level = jnp.broadcast_to(sigma, found.shape[:-2]).reshape(-1)
        image = denoised(network, flat, level, jnp.mean(flat, axis=(1, 2)))
        return jnp.maximum(image.reshape(found.shape), 0)

    image = step(first, plug_and_play.largest_deviation(first))
    largest = jax.lax.stop_gradient(plug_and_play.largest_deviation(image))
    course = largest * jnp.asarray(plug_and_play.course(plug_and_play.STEPS), largest.dtype)
    # Of each step only the image is kept: the rest is computed anew for its derivative.
    again = jax.checkpoint(lambda image, s: (step(image, s), None))
    # Unrolled: in a loop of XLA's a convolution on a CPU takes thirty times as long.
    image, _ = jax.lax.scan(again, image, course, unroll=True)
    shift = plug_and_play.shift_of(plug_and_play.FINAL * course[-1], precision)
    last = plug_and_play.data_step(normal, right, image, shift, precision)
    return jnp.maximum(last, 0)[0, 0]


def reconstruction_loss(
    network: DenoisingUNet, lesson: Reconstructions
) -> tuple[Array, dict[str, Any]]:
    """Mean error in dB of the images, and of denoising their crops with a weight of 0.4."""
    crops = lesson.crops
    error = jnp.mean((reconstructed(network, lesson) - crops.clean) ** 2, axis=(1, 2))
    error = error / (jnp.mean(crops.clean**2, axis=(1, 2)) + _DARK)
    left = denoised(network, crops.noisy, crops.sigma, crops.centre) - crops.clean
    white = jnp.mean(left**2, axis=(1, 2)) / crops.sigma**2
    image, noise = (10 * jnp.mean(jnp.log10(e + _LEAST_ERROR)) for e in (error, white))
    return image + _WHITE * noise, {"image": image, "denoised": noise}
