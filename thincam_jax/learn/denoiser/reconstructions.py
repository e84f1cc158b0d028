r"""Lessons of reconstruction: a denoiser learns inside plug and play, behind drawn cameras.

What a data step leaves is not white: it has the noise of some frequencies, and the errors that the
denoiser made before at those that the camera hardly shows. The whole course of `PlugAndPlay` is
therefore differentiated, data steps by the implicit function theorem (Zhang, van Gool, Timofte,
USRNet, CVPR 2020, learn so behind blurs). No camera of a user is among those drawn.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.learn import plug_and_play
from thincam_jax.learn.denoiser.crops import Crops, draw_crops
from thincam_jax.learn.denoiser.drawn_cameras import drawn_kernels
from thincam_jax.learn.denoiser.network import denoised
from thincam_jax.learn.denoiser.unet import DenoisingUNet
from thincam_jax.reconstruction.normal_equations import normal_equations
from thincam_jax.reconstruction.problem import InverseProblem, back_projected, uniform_image

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
