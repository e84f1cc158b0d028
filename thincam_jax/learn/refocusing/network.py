r"""The network: unrolled ADMM over a stack of planes, and heads that read the stack.

The scene is explained by a stack of planes at fixed distances, evenly spaced in 1/t. Its start is
the joint linear estimate of all planes; then each of a few steps lets a U-Net that is shared by
all of them clean the stack and ties the result to the capture again, by the exact optics and the
sensor's crop. So light from all distances is in the model, whichever is focused on.

Any distance follows from the stack: a lens focused there is rendered from it, and what that cannot
hold, a small U-Net adds, which sees the stack *relative to the commanded distance* and inversions
by the exact PSF at that distance. Trained distances are not special.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.lens_blur import lens_blur
from thincam_jax.learn.refocusing.linear import LinearStep, Sizes
from thincam_jax.learn.refocusing.planes import Planes
from thincam_jax.learn.refocusing.unet import UNet


class NetworkOptions(NamedTuple):
    """What a network is built with.

    - `steps`: of the unrolled ADMM, each with one pass of the shared U-Net.
    - `widths`: channels of that U-Net's levels; `head_widths`: of the two heads'.
    - `reach`: planes to each side of the commanded distance that the focusing head tells apart.
    """

    steps: int = 4
    widths: tuple[int, ...] = (40, 56, 72)
    head_widths: tuple[int, ...] = (32, 48, 64)
    reach: int = 3


DEFAULT = NetworkOptions()


class Explained(NamedTuple):
    """A capture explained by a stack of planes, from which everything else is read.

    - `stack`: (plane, y, x), radiance in units of the scene's mean.
    - `residual`: capture − explained capture on the sensor, the same unit after optics.
    - `mean`: the scene's mean radiance.
    - `deviation`: standard deviation of the noise per pixel, in the residual's unit.
    """

    stack: Float[Array, "plane y x"]
    capture: Float[Array, "y x"]
    residual: Float[Array, "y x"]
    mean: Float[Array, ""]
    deviation: Float[Array, ""]


class DistanceMap(NamedTuple):
    """Distances per pixel.

    - `distance`: mm.
    - `confidence`: probability, as learnt, that 1/t is right within half a step of the planes.
    """

    distance: Float[Array, "*batch y x"]
    confidence: Float[Array, "*batch y x"]


class Weights(eqx.Module):
    """All that is learnt.

    - `linear`: the linear step before each U-Net pass; the first is the start.
    - `data`: logit of the weight of the capture against its own explanation, after each step.
    - `dual`: how much of what the U-Net took away is kept in mind, after each step.
    - `prior`, `focus`, `maps`: U-Nets of the stack, focused images, all-in-focus and distance.
    - `at_distance`: the linear step at the commanded distance, on the capture and on the residual.
    """

    linear: tuple[LinearStep, ...]
    data: Float[Array, " step"]
    dual: Float[Array, " step"]
    prior: UNet
    focus: UNet
    maps: UNet
    at_distance: tuple[LinearStep, LinearStep]


class RefocusNetwork(eqx.Module):
    """A network and the camera whose captures it takes.

    - `weights`: all that is learnt.
    - `planes`: of its camera; not learnt, and rebuilt from the camera when a network is loaded.

    Captures are (*batch, y, x) in any unit; `deviation` is the standard deviation of their noise
    per pixel in the same unit, one number or one for each capture. Images come back as the field is
    projected on the sensor (turned by 180°), in the unit in which a uniform scene of radiance 1
    makes the PSF's light.
    """

    weights: Weights
    planes: Planes
    options: NetworkOptions = eqx.field(static=True)

    @staticmethod
    def create(
        camera: RefocusCamera, options: NetworkOptions = DEFAULT, *, key: PRNGKeyArray
    ) -> "RefocusNetwork":
        """An untrained network: its U-Nets add nothing."""
        if options.steps < 1 or options.reach < 1:
            raise ValueError(f"steps and reach are {options.steps} and {options.reach}; at least 1")
        prior, focus, maps = jax.random.split(key, 3)
        count, steps = camera.planes, options.steps
        relative = 2 * options.reach + 1
        weights = Weights(
            linear=tuple(LinearStep(count, slope=1.0 if n == 0 else 0.5) for n in range(steps)),
            data=jnp.zeros(steps - 1),
            dual=jnp.full(steps - 1, 0.5),
            prior=UNet(count + 3, count, options.widths, key=prior),
            focus=UNet(relative + 6, 1, options.head_widths, key=focus),
            maps=UNet(count + 2, count + 2, options.head_widths, key=maps),
            at_distance=(LinearStep(1), LinearStep(1, power=0.1, slope=0.5)),
        )
        return RefocusNetwork(weights, Planes(camera), options)

    @property
    def camera(self) -> RefocusCamera:
        return self.planes.camera

    def focus(self, captures, distance, deviation) -> Float[Array, "*batch y x"]:
        """Images as a lens of the camera's pupil, focused on `distance` (mm), would see them."""
        return _batched(_focus, self, captures, deviation, self.camera.within(distance))

    def sweep(self, captures, distances, deviation) -> Float[Array, "distance *batch y x"]:
        """`focus` at each of `distances`; the captures are explained once."""
        distances = self.camera.within(distances)
        images = _batched(_sweep, self, captures, deviation, distances)
        return jnp.moveaxis(images, -3, 0)

    def all_in_focus(self, captures, deviation) -> Float[Array, "*batch y x"]:
        """Images in which everything is sharp, as a pinhole would see the scene."""
        return _batched(_all_in_focus, self, captures, deviation)

    def distance(self, captures, deviation) -> DistanceMap:
        """The distance of what each pixel shows."""
        return _batched(distance_map, self, captures, deviation)

    def consistency(self, captures, deviation) -> Float[Array, "*batch"]:
        """Residual of the explained capture, root mean square, over the noise's deviation.

        About 1: the stack explains all that was seen but noise. Far more: the image is not of this
        capture. Far less: noise was explained, too.
        """
        return _batched(consistency_of, self, captures, deviation)


def explain(
    network: RefocusNetwork, capture: Float[Array, "y x"], deviation: Float[Array, ""]
) -> Explained:
    """The stack of planes that explains a capture."""
    weights, planes = network.weights, network.planes
    dtype, spectra, sizes = planes.dtype, planes.spectra, sizes_of(planes)
    unit = planes.unit.astype(dtype)
    mean = planes.mean(capture)
    # A dark capture has the mean 0 and stays dark.
    scale = 1 / (unit * jnp.where(mean > 0, mean, 1))
    capture, sigma = capture * scale, deviation * scale
    variance = sigma**2
    level = noise_level(sigma)

    # A uniform scene first: its light is most of the capture, and not in the learnt powers.
    estimate = jnp.full((spectra.shape[0], *sizes.field_shape), 1 / spectra.shape[0], dtype)
    target = planes.from_field(estimate)
    unseen = jnp.fft.irfft2(jnp.sum(target * spectra, axis=0), s=sizes.window)
    # What the data's split takes the window to show: the capture on the sensor, a guess beside it.
    split = unseen + planes.from_sensor(capture - planes.on_sensor(unseen))
    data_dual, dual = jnp.zeros_like(capture), jnp.zeros_like(estimate)
    for step, linear in enumerate(weights.linear):
        residual = jnp.fft.rfft2(split) - jnp.sum(target * spectra, axis=0)
        solved = target + linear(residual, spectra, variance, sizes)
        noisy = planes.on_field(solved) + dual
        total = jnp.sum(noisy, axis=0, keepdims=True)
        told = constant_images(noisy, level, step / len(weights.linear))
        estimate = noisy + weights.prior(jnp.concatenate([noisy, total, told]))
        if step + 1 < len(weights.linear):
            dual = weights.dual[step].astype(dtype) * (noisy - estimate)
            target = planes.from_field(estimate - dual)
            # The proximal map of the data: a weighted mean on the sensor, nothing beside it.
            seen = jnp.fft.irfft2(jnp.sum(solved * spectra, axis=0), s=sizes.window)
            gap = capture - planes.on_sensor(seen) - data_dual
            gap = jax.nn.sigmoid(weights.data[step]).astype(dtype) * gap
            split = seen + planes.from_sensor(data_dual + 2 * gap)
            data_dual = -gap
    explained = jnp.sum(planes.from_field(estimate) * spectra, axis=0)
    return Explained(estimate, capture, capture - planes.seen(explained), mean, sigma)


def focused(
    network: RefocusNetwork, explained: Explained, distance: Float[Array, ""]
) -> Float[Array, "y x"]:
    """The image of a lens focused on a distance, in units of the scene's mean."""
    weights, planes, camera = network.weights, network.planes, network.camera
    dtype = planes.dtype
    inverse = 1 / distance.astype(dtype)
    difference = camera.inverse_distances.astype(dtype) - inverse
    radius = camera.defocus_radius(difference)
    blurred = lens_blur(explained.stack, radius, camera.largest_blur)
    rendered = jnp.sum(blurred, axis=0)
    before = jax.nn.sigmoid(4 * difference / camera.step)  # what stands before the focus
    front = jnp.tensordot(before, blurred, axes=1)
    # The stack by its distance from the focus, in steps of the planes; the farthest taken together.
    reach = network.options.reach
    offset = jnp.clip(difference / camera.step, -reach, reach)
    places = jnp.asarray(np.arange(-reach, reach + 1), dtype)[:, None]
    nearness = jnp.maximum(1 - jnp.abs(offset - places), 0)
    relative = jnp.einsum("rk,kyx->ryx", nearness, explained.stack)

    spectra, sizes = planes.spectrum_at(distance.astype(dtype))[None], sizes_of(planes)
    variance = explained.deviation**2
    uniform = planes.uniform.astype(dtype) / planes.unit.astype(dtype)
    on_capture, on_residual = weights.at_distance

    def inverted(step: LinearStep, image) -> Float[Array, "1 y x"]:
        spectrum = jnp.fft.rfft2(planes.from_sensor(image))
        return planes.on_field(step(spectrum, spectra, variance, sizes))

    sharp = 1 + inverted(on_capture, explained.capture - uniform)
    missing = inverted(on_residual, explained.residual)
    level = noise_level(explained.deviation)
    total = jnp.sum(explained.stack, axis=0)
    told = constant_images(relative, level)
    parts = [relative, rendered[None], front[None], total[None], sharp, missing, told]
    return rendered + weights.focus(jnp.concatenate(parts))[0]


class Maps(NamedTuple):
    """What the head of maps says, in units of the scene's mean and of the planes' step.

    - `all_in_focus`: (y, x).
    - `share`: of each plane in what a pixel shows, (plane, y, x), sum 1.
    - `spread`: mean absolute error of 1/t that it expects, in steps of the planes.
    """

    all_in_focus: Float[Array, "y x"]
    share: Float[Array, "plane y x"]
    spread: Float[Array, "y x"]


def mapped(network: RefocusNetwork, explained: Explained) -> Maps:
    """All in focus, and the distance of each pixel."""
    stack = explained.stack
    total = jnp.sum(stack, axis=0)
    level = noise_level(explained.deviation)
    parts = [stack, total[None], constant_images(stack, level)]
    out = network.weights.maps(jnp.concatenate(parts))
    share = jax.nn.softmax(out[1:-1], axis=0)
    return Maps(total + out[0], share, jax.nn.softplus(out[-1]) + 0.02)


def inverse_distance(network: RefocusNetwork, maps: Maps) -> Float[Array, "y x"]:
    """1/t of each pixel, 1/mm: the planes' mean by their shares."""
    return jnp.tensordot(network.camera.inverse_distances, maps.share, axes=1)


def sizes_of(planes: Planes) -> Sizes:
    rows, columns = planes.operator.sensor_shape
    return Sizes(planes.window, planes.operator.field_shape, rows * columns)


def noise_level(deviation: Float[Array, ""]) -> Float[Array, ""]:
    """What a U-Net is told of the noise: log₁₀ of its deviation, in units of the scene's mean."""
    return jnp.log10(deviation**2 + 1e-8) / 2


def constant_images(like, *values) -> Float[Array, "value y x"]:
    """Constant images."""
    shape = like.shape[-2:]
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), shape) for v in values])


def flattened(network: RefocusNetwork, captures, deviation):
    """Captures (element, y, x), the deviation of each, and the batch axes that they had."""
    captures = jnp.asarray(captures, network.planes.dtype)
    sensor = network.camera.camera.sensor.shape
    if captures.shape[-2:] != sensor:
        raise ValueError(
            f"captures have shape {captures.shape}; give (…, {sensor[0]}, {sensor[1]})"
        )
    batch = captures.shape[:-2]
    deviation = jnp.broadcast_to(jnp.asarray(deviation, captures.dtype), batch)
    return captures.reshape(-1, *sensor), deviation.reshape(-1), batch


def _batched(function, network: RefocusNetwork, captures, deviation, *distance):
    """A function of one capture over all axes before the last two."""
    *flat, batch = flattened(network, captures, deviation)
    out = _over_batch(function, network, *flat, *distance)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), out)


@eqx.filter_jit
def _over_batch(function, network, captures, deviation, *distance):
    def one(capture, deviation):
        return function(network, explain(network, capture, deviation), *distance)

    return jax.vmap(one)(captures, deviation)


def _focus(network, explained, distance):
    return explained.mean * focused(network, explained, distance)


def _sweep(network, explained, distances):
    # Side by side: in a loop XLA runs convolutions slowly on a CPU.
    return jax.vmap(lambda t: _focus(network, explained, t))(distances)


def _all_in_focus(network, explained):
    return explained.mean * mapped(network, explained).all_in_focus


def distance_map(network: RefocusNetwork, explained: Explained) -> DistanceMap:
    """Of one capture."""
    maps = mapped(network, explained)
    # Of a Laplace distribution with that mean absolute error.
    confidence = -jnp.expm1(-0.5 / maps.spread)
    return DistanceMap(1 / inverse_distance(network, maps), confidence)


def consistency_of(network: RefocusNetwork, explained: Explained) -> Float[Array, ""]:
    """Of one capture."""
    del network
    rms = jnp.sqrt(jnp.mean(explained.residual**2))
    return rms / jnp.where(explained.deviation > 0, explained.deviation, 1)
