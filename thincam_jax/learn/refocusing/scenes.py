r"""Scenes with depth: layers that hide each other, as the camera and as a lens see them.

All random numbers are arguments, uniform from 0 to 1: one draw for a scene compiles far faster
than one for each.

A layer is a picture, how much of each pixel it covers, and a distance with some relief; light
comes from (layer, part): a layer with relief is shared out between a few flat parts.

A point behind a layer sends light past it to some of the mask. In the mean over the mask, which is
a pupil of its width, it sees the share 1 − blur(cover), blurred by the defocus between both: that
is what a captured layer is dimmed by. A lens focused elsewhere sees

.. math:: I = \sum_l \mathrm{blur}_l(\alpha_l F_l)
    \prod_{m\ \text{in front}} (1 - \mathrm{blur}_m(\alpha_m))

which is exact for one layer over another when one of both is in focus.
"""

from dataclasses import dataclass
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import centred_indices, fast_shape
from thincam_jax._core.quantity import check_fields, quantity
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.learn.refocusing.cameras import RefocusCamera


def lens_blur(
    images: Float[Array, "*plane y x"], radius: Float[Array, "*plane"], largest: int
) -> Float[Array, "*plane y x"]:
    """Images averaged over discs of these radii, pixels; the scene is dark beside its frame.

    A disc's samples are weighted by how much of them it covers, to first order, and sum to 1. At
    a radius of half a pixel or less the image stays as it is.

    `largest`: pixels from its middle that the widest disc reaches.
    """
    rows, columns = images.shape[-2:]
    along = centred_indices(2 * largest + 1, images.dtype)
    distance = jnp.sqrt(along[:, None] ** 2 + along**2)
    discs = jnp.clip(radius[..., None, None] + 0.5 - distance, 0, 1)
    # The middle sample is covered whole by any disc.
    discs = discs.at[..., largest, largest].set(1)
    discs = discs / jnp.sum(discs, axis=(-2, -1), keepdims=True)
    window = fast_shape((rows + 2 * largest, columns + 2 * largest), real=True)
    spectrum = jnp.fft.rfft2(place(images, (0, 0), window)) * jnp.fft.rfft2(
        place(discs, (0, 0), window)
    )
    return cut(jnp.fft.irfft2(spectrum, s=window), (largest, largest), (rows, columns))


_WAVES = 6
RELIEF_NUMBERS = 3 * _WAVES
COVER_NUMBERS = RELIEF_NUMBERS + 9


def random_cover(numbers: Float[Array, " number"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """Part of each pixel that an object covers, 0 to 1, with edges soft over about a pixel.

    With equal chances a turned ellipse or rectangle somewhere, a half plane of any direction, or
    blobs: where a sum of long waves is above a level. `numbers`: `COVER_NUMBERS` of them.
    """
    placed, wavy = numbers[:9], numbers[9:COVER_NUMBERS]
    rows, columns = shape
    unit = max(shape) / 2
    y = centred_indices(rows, numbers.dtype)[:, None] / unit
    x = centred_indices(columns, numbers.dtype)[None] / unit
    levels = jnp.stack([_object(placed, y, x), _half(placed, y, x), _blobs(wavy, placed[0], y, x)])
    level = levels[jnp.minimum((3 * placed[7]).astype(int), 2)]
    softness = (0.4 + 1.1 * placed[8]) / unit
    return jnp.clip(level / softness + 0.5, 0, 1)


def random_relief(numbers: Float[Array, " number"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """A smooth map from −1 to 1, slanted or curved surfaces; of `RELIEF_NUMBERS` numbers."""
    rows, columns = shape
    y = (jnp.arange(rows, dtype=numbers.dtype) / rows)[:, None]
    x = (jnp.arange(columns, dtype=numbers.dtype) / columns)[None]
    waves = _waves(numbers, y, x, 1.0)
    low, high = jnp.min(waves), jnp.max(waves)
    return 2 * (waves - low) / jnp.where(high > low, high - low, 1) - 1


def _object(placed, y, x):
    """Signed distance to a superellipse's edge, about, in half images."""
    centre = 1.6 * placed[:2] - 0.8
    radii = 0.2 * 4 ** placed[2:4]
    angle = jnp.pi * placed[4]
    power = jnp.where(placed[5] < 0.5, 2.0, 10.0).astype(radii.dtype)
    down, across = y - centre[0], x - centre[1]
    u = (across * jnp.cos(angle) + down * jnp.sin(angle)) / radii[0]
    v = (down * jnp.cos(angle) - across * jnp.sin(angle)) / radii[1]
    norm = (jnp.abs(u) ** power + jnp.abs(v) ** power) ** (1 / power)
    return (1 - norm) * jnp.min(radii)


def _half(placed, y, x):
    turn = 2 * jnp.pi * placed[4]
    return x * jnp.cos(turn) + y * jnp.sin(turn) - (placed[6] - 0.5)


def _blobs(wavy, level, y, x):
    # Divided by a typical slope: about a distance.
    return (_waves(wavy, y, x, 0.8) - (1.5 * level - 0.5)) / 5


def _waves(numbers, y, x, highest):
    """A sum of cosines of up to `highest` cycles per unit, of variance 1."""
    v, u, start = numbers.reshape(3, _WAVES, 1, 1)
    turns = highest * ((2 * v - 1) * y + (2 * u - 1) * x) + start
    return jnp.sum(jnp.cos(2 * jnp.pi * turns), axis=0) * (2 / _WAVES) ** 0.5


LAYERS = 3
PARTS = 3  # flat parts that a layer with relief is shared out between

_CHANCE, _CHANCES = (quantity(least=0.0, most=1.0, many=several) for several in (False, True))


@dataclass(frozen=True)
class SceneOptions:
    """Range of drawn scenes and of their captures.

    - `layers`: chances of one, two and three layers.
    - `dark`: chance that nothing is behind the last but one layer, objects on a dark ground.
    - `relief`: chance of a layer not to be flat; its 1/t then varies by up to ± `depth` parts of
      the range.
    - `snr_db`: range of Gaussian noise, dB, of the mean square of the capture.
    - `poisson`: chance of shot noise in its place; `electrons`, range of its mean number per pixel.
    - `distances`: mm, the only ones that scenes stand at and images are focused on; default any.
    """

    layers: Annotated[tuple[float, float, float], _CHANCES] = (0.35, 0.45, 0.2)
    dark: Annotated[float, _CHANCE] = 0.1
    relief: Annotated[float, _CHANCE] = 0.3
    depth: Annotated[float, _CHANCE] = 0.12
    snr_db: Annotated[tuple[float, float], quantity("dB", shape=(2,))] = (20.0, 45.0)
    poisson: Annotated[float, _CHANCE] = 0.2
    electrons: Annotated[tuple[float, float], quantity("electrons", shape=(2,))] = (50.0, 20000.0)
    distances: Annotated[
        tuple[float, ...] | None, quantity("mm", positive=True, many=True, optional=True)
    ] = None

    def __post_init__(self):
        check_fields(self)


DEFAULT = SceneOptions()
# Uniform random numbers of a layer: of its picture, its cover, its relief, and where it stands.
_CUT, _LAYER = 8, 5
_NUMBERS = (_CUT, COVER_NUMBERS, RELIEF_NUMBERS)


class LayeredScene(eqx.Module):
    """Layers from the front to the back, in directions: pixel (i, j) is one ray through the mask.

    - `radiance`: F, (layer, y, x); `cover`: α, (layer, y, x), 0 to 1.
    - `share`: share of a pixel in each flat part of its layer, (layer, part, y, x), sum 1.
    - `inverse`: 1/t of the parts, 1/mm, (layer, part).
    """

    radiance: Float[Array, "layer y x"]
    cover: Float[Array, "layer y x"]
    share: Float[Array, "layer part y x"]
    inverse: Float[Array, "layer part"]

    @property
    def visible(self) -> Float[Array, "layer y x"]:
        """Share of each layer in the view of a pinhole in the middle of the mask."""
        return self.cover * _seen_past(self.cover)

    @property
    def all_in_focus(self) -> Float[Array, "y x"]:
        """Image of a pinhole camera."""
        return jnp.sum(self.visible * self.radiance, axis=0)

    @property
    def inverse_map(self) -> Float[Array, "y x"]:
        """1/t of what each pixel of `all_in_focus` shows, 1/mm; on a dark ground the ground's."""
        each = jnp.sum(self.share * self.inverse[:, :, None, None], axis=1)
        visible = self.visible
        total = jnp.sum(visible, axis=0)
        known = jnp.sum(visible * each, axis=0) / jnp.maximum(total, 1e-3)
        return jnp.where(total > 1e-3, known, each[-1])

    def emission(self, camera: RefocusCamera) -> Float[Array, "layer part y x"]:
        """The light of each part that reaches the mask, the rest hidden by what is in front."""
        largest = camera.largest_blur
        middle = jnp.mean(self.inverse, axis=1)
        emitted = []
        for layer in range(LAYERS):
            seen = self.radiance[layer] * self.cover[layer]
            if layer:
                radius = camera.defocus_radius(middle[:layer] - middle[layer])
                hidden = lens_blur(self.cover[:layer], radius, largest)
                seen = seen * jnp.prod(1 - hidden, axis=0)
            emitted.append(self.share[layer] * seen)
        return jnp.stack(emitted)

    def focused(self, camera: RefocusCamera, inverse: Number) -> Float[Array, "y x"]:
        """Image by a lens of the camera's pupil, focused on 1/t = `inverse`, 1/mm."""
        radius = camera.defocus_radius(self.inverse - inverse)
        covered = self.share * self.cover[:, None]
        both = jnp.stack([covered, covered * self.radiance[:, None]])
        blurred = lens_blur(both, jnp.stack([radius, radius]), camera.largest_blur)
        cover, light = jnp.sum(blurred, axis=2)
        return jnp.sum(light * _seen_past(cover), axis=0)


class Batch(eqx.Module):
    """Scenes, their captures, and the targets of a network; a single one has no axis of elements.

    - `capture`: (element, y, x), in the camera's units.
    - `deviation`: root mean square of the noise per pixel, the same units.
    - `commanded`: t to focus on, mm, of each element; `image`: the scene as a lens focused there
      sees it, (element, y, x).
    - `all_in_focus`, `inverse`: (element, y, x), the latter 1/t, 1/mm.
    - `emission`: light of the parts, (element, layer, part, y, x).
    """

    capture: Float[Array, "*element rows columns"]
    deviation: Float[Array, "*element"]
    commanded: Float[Array, "*element"]
    image: Float[Array, "*element y x"]
    all_in_focus: Float[Array, "*element y x"]
    inverse: Float[Array, "*element y x"]
    emission: Float[Array, "*element layer part y x"]
    scene: LayeredScene

    @property
    def distance(self) -> Float[Array, "*element y x"]:
        """Distance of what each pixel shows, mm."""
        return 1 / self.inverse

    def target(self, camera: RefocusCamera, distance: Number) -> Float[Array, "element y x"]:
        """The scenes as a lens focused on one distance, mm, sees them."""
        return jax.vmap(lambda scene: scene.focused(camera, 1 / distance))(self.scene)


def draw_scene(
    key: PRNGKeyArray,
    images: Float[ArrayLike, "image side side"],
    camera: RefocusCamera,
    options: SceneOptions = DEFAULT,
) -> LayeredScene:
    """A random scene of pictures cut out of `images` anywhere, at any scale."""
    dtype, shape = camera.near.dtype, camera.field_shape
    drawn = jax.random.uniform(key, (LAYERS, sum(_NUMBERS) + _LAYER), dtype)
    cut, cover, relief, layer = jnp.split(drawn, np.cumsum(_NUMBERS), axis=1)
    images = jnp.asarray(images, dtype)
    radiance = jax.vmap(lambda n: _cut_out(n, images, shape))(cut)
    cover = jax.vmap(lambda n: random_cover(n, shape))(cover).at[-1].set(1)
    # Of `number` layers the last ones are there.
    number = 1 + jnp.sum(layer[0, 0] > np.cumsum(options.layers)[:-1] / sum(options.layers))
    there = (jnp.arange(LAYERS) >= LAYERS - number).astype(dtype)
    is_dark = (number > 1) & (layer[0, 1] < options.dark)
    there = there.at[-1].set(jnp.where(is_dark, 0, 1).astype(dtype))
    inverse, share = _depths(layer[:, 2:], relief, camera, options)
    return LayeredScene(radiance, cover * there[:, None, None], share, inverse)


def _depths(layer, relief, camera: RefocusCamera, options: SceneOptions):
    """1/t of the parts, nearer layers in front, and the share of each pixel in them."""
    near, far, dtype = 1 / camera.near, 1 / camera.far, camera.near.dtype
    middle = jnp.sort(_inverse_of(layer[:, 0], camera, options))[::-1]
    size = layer[:, 1] * options.depth * (near - far)
    chance = options.relief if options.distances is None else 0.0
    size = jnp.where(layer[:, 2] < chance, size, 0)
    offsets = jnp.linspace(-1, 1, PARTS, dtype=dtype)
    inverse = jnp.clip(middle[:, None] + size[:, None] * offsets, far, near)
    maps = jax.vmap(lambda n: random_relief(n, camera.field_shape))(relief)
    places = offsets[:, None, None] - maps[:, None]
    share = jnp.maximum(1 - jnp.abs(places) * ((PARTS - 1) / 2), 0)
    # A flat layer is one part.
    flat = jnp.zeros((PARTS, 1, 1), dtype).at[PARTS // 2].set(1)
    return inverse, jnp.where(size[:, None, None, None] > 0, share, flat)


def draw_batch(
    key: PRNGKeyArray,
    images: Float[ArrayLike, "image side side"],
    camera: RefocusCamera,
    options: SceneOptions = DEFAULT,
    size: int = 4,
) -> Batch:
    """`size` scenes, captured: the same for the same key."""
    return _draw_batch(key, jnp.asarray(images), camera, options, size)


@eqx.filter_jit
def _draw_batch(key, images, camera, options, size) -> Batch:
    return jax.vmap(lambda k: _draw_one(k, images, camera, options))(jax.random.split(key, size))


def _draw_one(key, images, camera: RefocusCamera, options: SceneOptions) -> Batch:
    drawn, others, noise = jax.random.split(key, 3)
    scene = draw_scene(drawn, images, camera, options)
    emission = scene.emission(camera)
    numbers = jax.random.uniform(others, (5,), camera.near.dtype)
    capture, deviation = _noisy(
        numbers[:2], noise, captured(camera, emission, scene.inverse), options
    )
    # What is there is mostly what one wants to see.
    objects = scene.inverse[(LAYERS * numbers[2]).astype(int) % LAYERS, PARTS // 2]
    other = _inverse_of(numbers[3], camera, options)
    inverse = jnp.where(numbers[4] < 0.75, objects, other)
    return Batch(
        capture,
        deviation,
        1 / inverse,
        scene.focused(camera, inverse),
        scene.all_in_focus,
        scene.inverse_map,
        emission,
        scene,
    )


def captured(
    camera: RefocusCamera,
    emission: Float[Array, "layer part m n"],
    inverse: Float[Array, "layer part"],
) -> Float[Array, "y x"]:
    """The noise-free capture of the light of parts (layer, part, y, x) at 1/t (layer, part)."""
    operator = camera.operator(1 / inverse.reshape(-1))
    return operator(emission.reshape(-1, *camera.field_shape))


def _noisy(numbers, key, clean, options: SceneOptions):
    """The capture with noise, and the noise's root mean square."""
    share = numbers[0]
    low, high = options.snr_db
    gaussian = jnp.mean(clean**2) * 10 ** (-(low + (high - low) * share) / 10)
    low, high = np.log(options.electrons)
    electrons = jnp.exp(float(low) + float(high - low) * share)
    # Normal in place of Poisson numbers, which differ little from 50 electrons on.
    shot = jnp.maximum(clean, 0) * jnp.mean(clean) / electrons
    variance = jnp.where(numbers[1] < options.poisson, shot, gaussian)
    noise = jnp.sqrt(variance) * jax.random.normal(key, clean.shape, clean.dtype)
    return clean + noise, jnp.sqrt(jnp.mean(variance))


def _inverse_of(number, camera: RefocusCamera, options: SceneOptions):
    """1/t, 1/mm, of uniform numbers."""
    if options.distances is not None:
        places = (len(options.distances) * number).astype(int) % len(options.distances)
        return 1 / jnp.asarray(options.distances, camera.near.dtype)[places]
    return 1 / camera.far + number * (1 / camera.near - 1 / camera.far)


def _cut_out(numbers, images, shape):
    """A part of one of the images, turned, mirrored, scaled, made darker."""
    which, zoom, gain, *turn = numbers[:6]
    image = images[(len(images) * which).astype(int) % len(images)]
    image = jnp.where(turn[0] < 0.5, image[::-1], image)
    image = jnp.where(turn[1] < 0.5, image[:, ::-1], image)
    image = jnp.where(turn[2] < 0.5, image.T, image)
    side = images.shape[-1]
    # From the whole image to as many of its pixels as the field has, or half the image.
    low = max(shape) / side
    high = max(1.0, 2 * low)
    scale = low * (high / low) ** zoom
    slack = jnp.asarray(shape, image.dtype) - scale * side  # negative: what is left to cut away
    out = jax.image.scale_and_translate(
        image, shape, (0, 1), jnp.stack([scale, scale]), numbers[6:8] * slack, "linear"
    )
    return jnp.clip(out, 0, 1) * (0.4 + 0.6 * gain)


def _seen_past(cover):
    """Share of each pixel that the layers in front leave free; layers from the front."""
    left = jnp.cumprod(1 - cover, axis=0)
    return jnp.concatenate([jnp.ones_like(cover[:1]), left[:-1]])
