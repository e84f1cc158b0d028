"""Examples for a trained reconstruction: photographs behind its camera, or captures with truths."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from thincam_jax.imaging.operators.crop_convolution import centred_crop
from thincam_jax.imaging.targets import middle_square, resize
from thincam_jax.learn.denoiser import pictures
from thincam_jax.learn.denoiser.pictures import Pictures
from thincam_jax.learn.imperfections import Imperfections
from thincam_jax.learn.sources import Entry, dead_leaves
from thincam_jax.learn.trained import PhysicsStep, operator_of, prepared, with_whole_field
from thincam_jax.measured.pairs import PairedCapture, Pairs
from thincam_jax.measured.preparation import Prepared
from thincam_jax.reconstruction.imaging_model import Psfs
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.studies.prepared import pixel_noise, prepared_recording

SIDE = 384  # pixels of a picture
# Correlation of an image with its truth, from which a network can learn; captures that are drawn at
# most for one that has it.
_FOUND, _TRIED = 0.6, 4


def photographs(folder: str | os.PathLike[str], *, licence: str = "") -> dict[str, Pictures]:
    """Middle squares of the images of a folder, by their names; see `denoiser.pictures`."""
    return pictures.photographs(folder, licence=licence, cut=_square)


def samples() -> dict[str, Pictures]:
    """Middle squares of scikit-image's own photographs."""
    return pictures.samples(_square)


def drawn(seed: int, count: int) -> Pictures:
    """Grey dead leaves, the same for the same seed."""
    images = dead_leaves(seed, count, SIDE)
    digest = hashlib.sha256(images.tobytes()).hexdigest()
    entry = Entry(f"dead leaves, seed {seed}, {count} images", digest, "drawn")
    return Pictures(np.repeat(images[..., None], 3, axis=-1).astype(np.float32), (entry,))


def _square(linear: np.ndarray) -> np.ndarray:
    square = middle_square(linear, min(linear.shape[:2]))
    return resize(square, (SIDE, SIDE)).astype(np.float32)[None]


class PreparedExamples(eqx.Module):
    """Input images of the network and truths in front of the sensor, both in the images' unit."""

    images: Float[Array, "*example input colour y x"]
    truth: Float[Array, "*example colour y x"]


def draw_scene(
    tiles: Float32[np.ndarray, "tile side side 3"],
    colours: int,
    sensor: tuple[int, int],
    field: tuple[int, int],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "colour m n"]:
    """One or two pictures in front of a black field, in random contrast, turned and mirrored.

    A half of them fill the view of the sensor and reach beyond; the others are smaller, of which a
    half are cut out along a smooth outline. For other than three colours each is a mixture.
    """
    scene = np.zeros((colours, *field), np.float32)
    fills = rng.random() < 0.5
    for _ in range(1 if fills else int(rng.integers(1, 3))):
        picture = tiles[rng.integers(len(tiles))]
        mixture = np.eye(3) if colours == 3 else rng.dirichlet(np.ones(3), colours)
        picture = np.einsum("yxc,kc->kyx", picture, mixture) ** np.exp(rng.uniform(-0.5, 0.4))
        picture = np.rot90(picture, int(rng.integers(4)), axes=(1, 2))
        picture = picture[..., :: rng.choice([-1, 1])]
        low, high = (max(sensor), 1.4 * max(sensor)) if fills else np.multiply((0.3, 0.9), sensor)
        side = max(8, min(int(rng.uniform(low, high)), *field))
        picture = np.moveaxis(resize(np.moveaxis(picture, 0, -1), (side, side)), -1, 0)
        if not fills and rng.random() < 0.5:
            picture = picture * _outline(side, rng)
        loose = (0.15 if fills else 0.4) * np.asarray(sensor)
        middle = [(n - side) / 2 + rng.uniform(-s, s) for n, s in zip(field, loose, strict=True)]
        y, x = (int(np.clip(m, 0, n - side)) for m, n in zip(middle, field, strict=True))
        part = scene[:, y : y + side, x : x + side]
        np.maximum(part, rng.uniform(0.3, 1) * picture, out=part)
    return scene


def _outline(side: int, rng: np.random.Generator) -> Float32[np.ndarray, "y x"]:
    """A disc whose radius is a random smooth function of the angle, with soft edges."""
    y, x = np.mgrid[:side, :side] / side - 0.5
    angle, radius = np.arctan2(y, x), np.full((side, side), 0.33)
    for order in range(1, 7):
        wave = np.cos(order * angle + rng.uniform(0, 2 * np.pi))
        radius = radius + 0.1 * rng.standard_normal() / order**0.5 * wave
    return np.clip((radius - np.hypot(y, x)) * side / 2 + 0.5, 0, 1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class CameraLessons:
    """Captures of pictures by a camera that is known by its PSF alone, each with its own faults.

    - `psf`: measured PSF, (colour, k, l); `sensor`: rows and columns of the captures.
    - `pictures`: see `draw_scene`. `faults`: those that the reconstruction does not know.
    """

    psf: Float32[np.ndarray, "colour k l"]
    sensor: tuple[int, int]
    pictures: Pictures
    faults: Imperfections = Imperfections()

    def drawn(self, seed: int, number: int) -> tuple[Recording, Float32[np.ndarray, "colour m n"]]:
        """A recording and its scene, in the whole field, by seed and number alone."""
        rng, colours = np.random.default_rng((seed, number)), len(self.psf)
        blank = np.ones((1, colours, *self.sensor), np.float32)
        operator = operator_of(with_whole_field(self.recorded(blank)).problem())
        sizes = colours, self.sensor, operator.field_shape
        scene = draw_scene(self.pictures.tiles, *sizes, rng)
        return self.recorded(self.faults.capture(operator, self.psf, scene, rng)[None]), scene

    def recorded(self, captures: Float32[np.ndarray, "1 *batch colour y x"]) -> Recording:
        """Captures with the measured PSF, which is wrong by what their faults are."""
        return Recording(captures, Psfs(self.psf[None]))

    def examples(self, physics: PhysicsStep, seed: int, count: int) -> PreparedExamples:
        """Input and truth of the network for drawn captures in which the physics step finds them.

        From others a network would learn to give a grey image.
        """
        made: list[PreparedExamples] = []
        for number in range(_TRIED * count):
            one = example(physics, *self.drawn(seed, number))
            if is_found(one) or _TRIED * count - number <= count - len(made):
                made.append(one)
            if len(made) == count:
                break
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)


def example(
    physics: PhysicsStep, recording: Recording, scene: Float[np.ndarray, "colour m n"]
) -> PreparedExamples:
    """Example of one capture; in half precision, as thousands are kept."""
    images, _ = prepared(physics, *physics(recording))
    seen = np.asarray(centred_crop(jnp.asarray(scene), images.shape[-2:]))
    truth = levelled(seen, np.asarray(images[-1]))
    return PreparedExamples(images.astype(jnp.float16), jnp.asarray(truth, jnp.float16))


def is_found(one: PreparedExamples) -> bool:
    """Whether the last image of an example correlates with its truth."""
    seen, known = (np.asarray(part, float).ravel() for part in (one.images[-1], one.truth))
    return bool(np.corrcoef(seen, known)[0, 1] > _FOUND)


def levelled(
    truth: Float[np.ndarray, "colour y x"], image: Float[np.ndarray, "colour y x"]
) -> Float[np.ndarray, "colour y x"]:
    """Truth with the gain and offset of each colour that bring it closest to an image.

    Uniform light of a scene that fills the field and uniform light beside it look alike in a
    capture: a network that had to tell them apart would learn little else.
    """
    known, seen = truth.astype(float), image.astype(float)
    middle, level = (one.mean(axis=(1, 2), keepdims=True) for one in (known, seen))
    power = np.sum((known - middle) ** 2, axis=(1, 2), keepdims=True)
    together = np.sum((known - middle) * (seen - level), axis=(1, 2), keepdims=True)
    return together / np.maximum(power, 1e-30) * (known - middle) + level


@dataclass(frozen=True, eq=False)
class PairLessons:
    """Captures with their truths, of which each example takes the next one.

    - `ready`: prepares a pair, as for a reconstruction.
    - `first`, `most`: number of the first pair, and how many there are at most.
    """

    pairs: Pairs
    ready: Callable[[PairedCapture], Prepared]
    first: int
    most: int

    @property
    def manifest(self) -> tuple[Entry, ...]:
        """Entries of the pairs, with the sum of capture and truth."""
        pairs, numbers = self.pairs, range(self.first, self.first + self.most)
        return tuple(Entry(pairs.names[n], pairs.digest(n), pairs.licence) for n in numbers)

    def examples(self, physics: PhysicsStep, seed: int, count: int) -> PreparedExamples:
        """Input and truth of the network; see `levelled`."""
        numbers = range(self.first, self.first + min(count, self.most))
        made = [self._example(physics, self.pairs[number]) for number in numbers]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)

    def _example(self, physics: PhysicsStep, pair: PairedCapture) -> PreparedExamples:
        ready = self.ready(pair)
        recording = prepared_recording(ready, pixel_noise(ready))
        images, _ = prepared(physics, *physics(recording))
        aligned = self.pairs.alignment.matched
        matched = [aligned(np.asarray(one), pair.truth, ready.log) for one in images]
        inside, truth = np.stack([one for one, _ in matched]), matched[-1][1]
        both = inside, levelled(truth, inside[-1])
        return PreparedExamples(*(jnp.asarray(one, jnp.float16) for one in both))
