r"""The network: unrolled half-quadratic splitting over a stack of planes, one of them in focus.

The scene is explained by a stack of planes, evenly spaced in 1/t and shifted so that one of them
stands exactly at the commanded distance. The start is the joint linear estimate of all planes. Each
step then lets a U-Net clean the stack and ties the result to the capture again, by the exact
optics and the sensor's crop. So light from all distances is in the model, whichever is focused on.

U-Nets see the stack *relative to the commanded distance*: trained distances are not special. The
last one says the rest, too: what a lens focused there sees beside what is rendered of the stack,
the image in which all is sharp, and where each pixel stands.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, check_fields, whole
from thincam_jax._core.random import Key, random_key
from thincam_jax._core.text import of_error
from thincam_jax.learn.checkpoint import (
    CheckpointError,
    network_description,
    read_weights,
    write_arrays,
)
from thincam_jax.learn.refocusing import store
from thincam_jax.learn.refocusing.cameras import RefocusCamera, Stand
from thincam_jax.learn.refocusing.planes import LinearStep, Planes
from thincam_jax.learn.refocusing.scenes import lens_blur
from thincam_jax.learn.refocusing.unet import UNet
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.imaging_model import Cameras

_BLUR = 0.5  # pixels by which a lens blurs more from one image of a map of distances to the next


@checked
@dataclass(frozen=True)
class NetworkOptions:
    """Architecture of a network.

    - `steps`: unrolled steps, each with a U-Net of its own.
    - `widths`: channels of the U-Nets' levels.
    """

    steps: Annotated[int, whole(1, 20)] = 2
    widths: Annotated[tuple[int, ...], whole(1, 1024, many=True)] = (40, 44, 44, 44, 40)

    def __post_init__(self):
        check_fields(self)
        if not 0 < len(self.widths) <= 16:
            raise FieldError(f"widths has {len(self.widths)} levels; give 1 to 16", "widths")


DEFAULT = NetworkOptions()


class Cleaned(eqx.Module):
    """Input of a U-Net from the images of a step, in units of the scene's mean.

    - `stack`: (plane, y, x), radiance.
    - `image`: view by a lens that is focused on the commanded distance.
    - `all_in_focus`: view by a pinhole.
    - `share`: share of each plane in what a pixel shows, (plane, y, x), sum 1.
    - `spread`: mean absolute error of 1/t that is expected, in steps of the planes.
    """

    stack: Float[Array, "plane y x"]
    image: Float[Array, "y x"]
    all_in_focus: Float[Array, "y x"]
    share: Float[Array, "plane y x"]
    spread: Float[Array, "y x"]

    def inverse_distance(self, stand: Stand) -> Float[Array, "y x"]:
        """1/t of each pixel, 1/mm: the planes' mean by their shares."""
        return jnp.tensordot(stand.inverse, self.share, axes=1, precision="highest")


class DistanceMap(Module):
    """Distances per pixel.

    - `distance`: mm.
    - `confidence`: probability, as learnt, that 1/t is right within half a step of the planes.
    """

    distance: Float[Array, "*batch y x"]
    confidence: Float[Array, "*batch y x"]


class Explained(eqx.Module):
    """A capture explained by a stack of planes: what the last U-Net has read, and how well.

    - `mean`: the scene's mean radiance.
    - `consistency`: root mean square of the explained capture's residual over the noise's.
    """

    cleaned: Cleaned
    stand: Stand
    mean: Float[Array, ""]
    consistency: Float[Array, ""]

    @property
    def image(self) -> Float[Array, "y x"]:
        return self.mean * self.cleaned.image

    @property
    def all_in_focus(self) -> Float[Array, "y x"]:
        return self.mean * self.cleaned.all_in_focus

    @property
    def distance(self) -> DistanceMap:
        # Of a Laplace distribution with that mean absolute error.
        confidence = -jnp.expm1(-0.5 / self.cleaned.spread)
        return DistanceMap(1 / self.cleaned.inverse_distance(self.stand), confidence)


class Weights(eqx.Module):
    """The numbers of each step.

    - `joint`: the linear step of all planes, by their places relative to the commanded distance.
    - `alone`: image of the plane at the commanded distance, as if nothing stood elsewhere.
    - `prior`: the U-Net; all that is learnt.
    """

    joint: tuple[LinearStep, ...]
    alone: tuple[LinearStep, ...]
    prior: tuple[UNet, ...]


class RefocusNetwork(eqx.Module):
    """A network and the camera whose captures it takes.

    - `weights`: all that is learnt.
    - `planes`: planes of its camera; not learnt, and rebuilt from the camera when a network is
      loaded.

    Captures are (*batch, y, x) in any unit; `noise_std` is the standard deviation of their noise
    per pixel in the same unit, one number or one for each capture. Images come back as the field is
    projected on the sensor (turned by 180°), in the unit in which a uniform scene of radiance 1
    makes the PSF's light.
    """

    weights: Weights
    planes: Planes
    options: NetworkOptions = eqx.field(static=True)

    @staticmethod
    def create(
        camera: RefocusCamera, options: NetworkOptions = DEFAULT, *, key: Key
    ) -> "RefocusNetwork":
        """An untrained network, by a key or a seed: its U-Nets add nothing."""
        steps, places = options.steps, 2 * camera.planes - 1
        if steps < 1:
            raise ValueError(f"steps = {steps}; give at least 1")
        inputs, outputs = places + 5, 2 * places + 3
        powers, slopes = [0.3] + [0.03] * (steps - 1), [1.0] + [0.5] * (steps - 1)
        pairs = list(zip(powers, slopes, strict=True))
        keys = jax.random.split(random_key(key), steps)
        weights = Weights(
            tuple(LinearStep(places, power=p, slope=s) for p, s in pairs),
            tuple(LinearStep(1, power=p, slope=s, noise=0.3) for p, s in pairs),
            tuple(UNet(inputs, outputs, options.widths, key=k) for k in keys),
        )
        return RefocusNetwork(weights, Planes(camera), options)

    def save(self, path: str | os.PathLike[str], record: dict[str, Any] | None = None) -> Path:
        """Write the camera, the options, the `record` of the training, and the weights.

        `record`: JSON, such as the entries of the images, their licences, and scores.
        """
        described = {"camera": store.described(self.camera), "options": asdict(self.options)}
        description = {"kind": store.KIND, **described, "training": record or {}}
        return write_arrays(path, self.weights, description)

    @staticmethod
    @checked
    def load(
        path: str | os.PathLike[str], cameras: LenslessCamera | RefocusCamera | Cameras
    ) -> "RefocusNetwork":
        """Read a network that was trained for this camera.

        **Arguments**

        - `path`: a file, or "shipped", the network that comes with the package.
        - `cameras`: imaging model of the captures: the camera; the camera with its light, as
          `Cameras`; or all that the network was trained for. Its numbers are compared, to single
          precision.

        **Errors**: CheckpointError, one line, for a damaged file, and for another camera with the
        first number that differs and both its values; OSError for what cannot be read.
        """
        path = store.SHIPPED_FILE if str(path) == store.SHIPPED else path
        description = network_description(path, store.KIND)
        given = store.same_camera(str(path), description.get("camera", {}), cameras)
        try:
            stored = description["options"]
            options = NetworkOptions(**{**stored, "widths": tuple(stored["widths"])})
            structure = eqx.filter_eval_shape(
                lambda key: RefocusNetwork.create(given, options, key=key).weights,
                jax.random.key(0),
            )
        except Exception as error:  # whatever another's options bring about
            cause = f"{path}: options of another version ({of_error(error)})"
            raise CheckpointError(cause) from None
        return RefocusNetwork(read_weights(path, structure), Planes(given), options)

    @property
    def camera(self) -> RefocusCamera:
        return self.planes.camera

    def first(self, steps: int) -> "RefocusNetwork":
        """The network of the first steps alone, which is one, too."""
        all_ = self.weights
        weights = Weights(all_.joint[:steps], all_.alone[:steps], all_.prior[:steps])
        return RefocusNetwork(weights, self.planes, replace(self.options, steps=steps))

    def with_prior(self, number: int, prior: UNet) -> "RefocusNetwork":
        """Another U-Net in a step."""
        return eqx.tree_at(lambda n: n.weights.prior[number], self, prior)

    def focus(
        self, captures: Numbers, distance: Number, noise_std: Numbers
    ) -> Float[Array, "*batch y x"]:
        """Images as a lens of the camera's pupil, focused on `distance` (mm), would see them.

        - `distance`: one for all; or a map (y, x) of the image's pixels, each as a lens focused on
          its own distance would see it. `distance` gives such maps, in the same orientation.

        **Errors**: ValueError for a distance out of range, and for a map of another shape;
        TypeError for a traced map.
        """
        if not (shape := jnp.asarray(distance).shape)[1:]:
            return _batched("image", self, captures, noise_std, self.camera.within(distance))
        if shape != self.camera.field_shape:
            raise ValueError(
                f"distance has shape {shape}; give one distance in mm, several to sweep, or a map "
                f"of the image's pixels, {self.camera.field_shape}"
            )
        if checks.is_traced(distance):
            raise TypeError("a map of distances needs known numbers: call it outside of jit")
        inverse = 1 / np.asarray(self.camera.within(distance), float)
        levels = self._levels(inverse)
        images = self.sweep(captures, 1 / levels, noise_std)
        place = np.interp(inverse, levels, np.arange(len(levels)))
        shares = np.clip(1 - np.abs(place - np.arange(len(levels))[:, None, None]), 0, None)
        shares = jnp.asarray(shares, images.dtype)
        return jnp.einsum("lyx,l...yx->...yx", shares, images, precision="highest")

    def _levels(self, inverse: Float[np.ndarray, "y x"]) -> Float[np.ndarray, " level"]:
        """1/t, ascending, between which images of a map are interpolated: all, or a close ladder.

        From step to step of the ladder a lens blurs by less than half a pixel more.
        """
        levels = np.unique(inverse)
        blur = float(self.camera.defocus_radius(levels[-1] - levels[0]))
        steps = math.ceil(blur / _BLUR) + 1
        return levels if len(levels) <= steps else np.linspace(levels[0], levels[-1], steps)

    def sweep(
        self, captures: Numbers, distances: Numbers | Sequence[Number], noise_std: Numbers
    ) -> Float[Array, "distance *batch y x"]:
        """`focus` at each of `distances`, mm, (distance,).

        **Errors**: ValueError for a distance out of range, and for other than a list of them.
        """
        if len(shape := jnp.asarray(distances).shape) != 1:
            raise ValueError(
                f"distances have shape {shape}; give a list of them, such as [60, 120] mm"
            )
        distances = self.camera.within(distances)
        images = _batched("image", self, captures, noise_std, distances)
        return jnp.moveaxis(images, -3, 0)

    def all_in_focus(self, captures: Numbers, noise_std: Numbers) -> Float[Array, "*batch y x"]:
        """Images in which everything is sharp, as a pinhole would see the scene."""
        return _batched("all_in_focus", self, captures, noise_std)

    def distance(self, captures: Numbers, noise_std: Numbers) -> DistanceMap:
        """The distance of what each pixel shows."""
        return _batched("distance", self, captures, noise_std)

    def consistency(self, captures: Numbers, noise_std: Numbers) -> Float[Array, "*batch"]:
        """Residual of the explained capture, root mean square, over the noise's deviation.

        About 1: the stack explains all that was seen but noise. Far more: the image is not of this
        capture. Far less: noise was explained, too.
        """
        return _batched("consistency", self, captures, noise_std)


def explain(
    network: RefocusNetwork,
    capture: Float[Array, "y x"],
    noise_std: Float[Array, ""],
    distance: Float[Array, ""],
) -> Explained:
    """The stack of planes that explains a capture, focused on a distance, mm."""
    weights, planes = network.weights, network.planes
    mean, capture, sigma = normalised(planes, capture, noise_std)
    stand = network.camera.stand(distance.astype(planes.dtype))
    spectra = planes.spectra_at(1 / stand.inverse)
    given = (capture, sigma, stand, spectra)
    cleaned = read_images(weights.prior[0], prepared(network, 0, None, given), stand)
    for number, prior in list(enumerate(weights.prior))[1:]:
        cleaned = read_images(prior, prepared(network, number, cleaned.stack, given), stand)
    residual = capture - seen_of(planes, cleaned.stack, spectra)
    rms = jnp.sqrt(jnp.mean(residual**2))
    return Explained(cleaned, stand, mean, rms / jnp.where(sigma > 0, sigma, 1))


def normalised(planes: Planes, capture: Float[Array, "y x"], noise_std: Float[Array, ""]):
    """The scene's mean, and capture and noise in units of it after optics."""
    mean = planes.mean(capture)
    # A dark capture has the mean 0 and stays dark.
    scale = 1 / (planes.unit.astype(planes.dtype) * jnp.where(mean > 0, mean, 1))
    return mean, capture * scale, noise_std * scale


def prepared(
    network: RefocusNetwork,
    number: int,
    stack: Float[Array, "plane m n"] | None,
    given: tuple[Any, ...],
) -> Float[Array, "image y x"]:
    """Input of the U-Net of a step, (image, y, x).

    The stack that the step before has left, tied to the capture, by the places relative to the
    commanded distance; what a lens and a pinhole see of it; the plane at the commanded distance as
    if nothing stood elsewhere; two constants, the noise and the commanded distance.

    `stack`: none before the first step; `given`: capture and noise, `normalised`, the planes and
    their spectra.
    """
    planes, camera = network.planes, network.camera
    joint, alone = network.weights.joint[number], network.weights.alone[number]
    capture, sigma, stand, spectra = given
    variance = sigma**2
    if stack is None:
        # A uniform scene first: its light is most of the capture, and not in the powers.
        count = stand.inverse.size
        stack = jnp.full((count, *camera.field_shape), 1 / count, planes.dtype)
        residual = capture - planes.uniform.astype(planes.dtype) / planes.unit.astype(planes.dtype)
    else:
        residual = capture - seen_of(planes, stack, spectra)
    spectrum = jnp.fft.rfft2(planes.from_sensor(residual))
    tied = stack + planes.on_field(joint(spectrum, spectra, variance, planes, stand.place))
    there = spectra[stand.number][None]
    sharp = planes.on_field(alone(spectrum, there, variance, planes))
    radius = camera.defocus_radius(stand.inverse - stand.inverse[stand.number])
    lens = jnp.sum(lens_blur(tied, radius, camera.largest_blur), axis=0, keepdims=True)
    total = jnp.sum(tied, axis=0, keepdims=True)
    relative = jnp.tensordot(stand.place, tied, axes=1, precision="highest")
    constants = constant_images(tied, noise_level(sigma), stand.position)
    return jnp.concatenate([relative, lens, total, sharp, constants])


def read_images(prior: UNet, images: Float[Array, "image y x"], stand: Stand) -> Cleaned:
    """Output of a U-Net for the images of a step."""
    places, found = len(stand.place), prior(images)
    shares = jnp.tensordot(stand.place.T, found[places:-3], axes=1, precision="highest")
    return Cleaned(
        jnp.tensordot(stand.place.T, images[:places] + found[:places], axes=1, precision="highest"),
        images[places] + found[-3],
        images[places + 1] + found[-2],
        jax.nn.softmax(shares, axis=0),
        jax.nn.softplus(found[-1]) + 0.02,
    )


def seen_of(
    planes: Planes, stack: Float[Array, "plane m n"], spectra: Complex[Array, "plane v u"]
) -> Float[Array, "y x"]:
    """The capture of a stack."""
    return planes.seen(jnp.sum(planes.from_field(stack) * spectra, axis=0))


def noise_level(noise_std: Float[Array, ""]) -> Float[Array, ""]:
    """Noise level as a U-Net reads it: log₁₀ of its deviation, in units of the scene's mean."""
    return jnp.log10(noise_std**2 + 1e-8) / 2


def constant_images(like: Float[Array, "..."], *values: Number) -> Float[Array, "value y x"]:
    """Constant images."""
    shape = like.shape[-2:]
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), shape) for v in values])


def flattened(network: RefocusNetwork, captures: Numbers, noise_std: Numbers):
    """Captures (element, y, x), the deviation of each, and the batch axes that they had."""
    captures = jnp.asarray(captures, network.planes.dtype)
    sensor = network.camera.camera.sensor.shape
    if captures.shape[-2:] != sensor:
        raise ValueError(
            f"captures have shape {captures.shape}; give (…, {sensor[0]}, {sensor[1]})"
        )
    batch = captures.shape[:-2]
    noise_std = jnp.broadcast_to(jnp.asarray(noise_std, captures.dtype), batch)
    return captures.reshape(-1, *sensor), noise_std.reshape(-1), batch


def _batched(what: str, network: RefocusNetwork, captures, noise_std, distance=None):
    """A property of the explanation of each capture, focused on the same distance or distances."""
    captures, noise_std, batch = flattened(network, captures, noise_std)
    out = _explained(what, network, captures, noise_std, distance)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), out)


@eqx.filter_jit
def _explained(what: str, network: RefocusNetwork, captures, deviations, distance):
    distance = network.camera.middle if distance is None else distance

    def one(capture, noise_std, distance):
        return getattr(explain(network, capture, noise_std, distance), what)

    # Side by side: in a loop XLA runs convolutions slowly on a CPU.
    several = one if distance.ndim == 0 else jax.vmap(one, in_axes=(None, None, 0))
    return jax.vmap(several, in_axes=(0, 0, None))(captures, deviations, distance)
