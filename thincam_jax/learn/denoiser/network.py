"""The denoiser: an image and its noise level in, the image without noise out; and its file."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
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
from thincam_jax.learn.sources import Entry, from_json
from thincam_jax.learn.unet import blocks_to_channels, channels_to_blocks, convolved

_IMAGES = 5  # of the input: the four pixels of a block, and the noise level


class ResidualKernels(eqx.Module):
    """x + C₂ ReLU(C₁ x), with 3×3 convolutions."""

    first: Float[Array, "c c 3 3"]
    second: Float[Array, "c c 3 3"]

    def __init__(self, channels: int, *, key: PRNGKeyArray):
        first, second = jax.random.split(key)
        self.first = _kernel(channels, channels, 3, first)
        self.second = 0.3 * _kernel(channels, channels, 3, second)

    def __call__(self, x: Float[Array, "c y x"]) -> Float[Array, "c y x"]:
        return x + convolved(jax.nn.relu(convolved(x, self.first)), self.second)


class Level(eqx.Module):
    """One resolution, and all coarser ones inside it.

    `before` and `after` are residual blocks, `down` makes one pixel of 2×2, `up` 2×2 of one.
    """

    before: tuple[ResidualKernels, ...]
    after: tuple[ResidualKernels, ...]
    down: Float[Array, "coarse fine 2 2"] | None
    up: Float[Array, "fine_of_four coarse 1 1"] | None
    inner: "Level | None"

    def __init__(self, widths: tuple[int, ...], blocks: tuple[int, ...], *, key: PRNGKeyArray):
        (width, *coarser), (count, *others) = widths, blocks
        keys = jax.random.split(key, 2 * count + 3)
        self.before = tuple(ResidualKernels(width, key=one) for one in keys[:count])
        self.after, self.down, self.up, self.inner = (), None, None, None
        if coarser:
            self.after = tuple(ResidualKernels(width, key=one) for one in keys[count : 2 * count])
            self.down = 0.7 * _kernel(width, coarser[0], 2, keys[-3])
            self.up = 0.7 * _kernel(coarser[0], 4 * width, 1, keys[-2])
            self.inner = Level(tuple(coarser), tuple(others), key=keys[-1])

    def __call__(self, x: Float[Array, "c y x"]) -> Float[Array, "c y x"]:
        for block in self.before:
            x = block(x)
        if self.inner is not None:
            assert self.down is not None and self.up is not None
            coarse = self.inner(convolved(x, self.down, stride=2))
            x = x + channels_to_blocks(convolved(coarse, self.up))
        for block in self.after:
            x = block(x)
        return x


class DenoisingUNet(eqx.Module):
    """The noise in an image (y, x), for its standard deviation; untrained it gives zeros.

    2×2 pixels become channels first and pixels again at the end, so that the widest convolutions
    run on a quarter of the pixels (Zhang, Zuo, Zhang, FFDNet, IEEE Trans. Image Process. 27, 4608,
    2018). The noise level is a channel, and no convolution has a bias (Zhang et al., DRUNet, IEEE
    Trans. Pattern Anal. 44, 6360, 2022), so that N(a y, a σ) = a N(y, σ) for every a > 0.

    **Arguments**: `widths`, channels of the levels from the finest; `blocks`, residual blocks of
    each, before and after the coarser ones.
    """

    enter: Float[Array, "c 5 3 3"]
    levels: Level
    leave: Float[Array, "4 c 3 3"]

    def __init__(self, widths: tuple[int, ...], blocks: tuple[int, ...], *, key: PRNGKeyArray):
        first, second = jax.random.split(key)
        self.enter = _kernel(_IMAGES, widths[0], 3, first)
        self.levels = Level(widths, blocks, key=second)
        self.leave = jnp.zeros((4, widths[0], 3, 3))

    @property
    def shape(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The `widths` and `blocks` that it was made of."""
        levels, level = [], self.levels
        while level is not None:
            levels.append(level)
            level = level.inner
        finer = [level.up.shape[0] // 4 for level in levels if level.up is not None]
        last = self.leave.shape[1] if len(levels) == 1 else levels[-2].down.shape[0]
        return (*finer, last), tuple(len(level.before) for level in levels)

    def __call__(self, image: Float[Array, "y x"], sigma: Float[Array, ""]) -> Float[Array, "y x"]:
        rows, columns = image.shape
        multiple = 2 ** len(self.shape[0])
        padded = jnp.pad(image, ((0, -rows % multiple), (0, -columns % multiple)), "reflect")
        pixels = blocks_to_channels(padded[None])
        level = jnp.broadcast_to(sigma.astype(image.dtype), (1, *pixels.shape[1:]))
        x = self.levels(convolved(jnp.concatenate([pixels, level]), self.enter))
        return channels_to_blocks(convolved(x, self.leave))[0, :rows, :columns]


def _kernel(inputs: int, outputs: int, side: int, key: PRNGKeyArray) -> Array:
    """Random kernel by He's rule, which keeps the variance through a ReLU."""
    spread = (2 / (side**2 * inputs)) ** 0.5
    return spread * jax.random.normal(key, (outputs, inputs, side, side))


_KIND = "denoiser"
SHIPPED = "shipped"
_SHIPPED_FILE = Path(__file__).with_name("shipped.thincam")
# Noise levels of the training, relative to a range of 1.
LEAST, MOST = 1 / 255, 100 / 255


@checked
@dataclasses.dataclass(frozen=True)
class DenoiserOptions:
    """Size of the network: see `DenoisingUNet`.

    **Errors**: ValueError for levels that do not fit each other.
    """

    widths: Annotated[tuple[int, ...], whole(1, 1024, many=True)] = (48, 56, 56, 56)
    blocks: Annotated[tuple[int, ...], whole(0, 64, many=True)] = (1, 1, 1, 1)

    def __post_init__(self):
        check_fields(self)
        if not 0 < len(self.widths) == len(self.blocks) <= 16 or sum(self.blocks) > 64:
            raise FieldError(
                f"widths = {self.widths}, blocks = {self.blocks}: give as many as widths, one for "
                "each of up to 16 levels, and up to 64 in all",
                "blocks",
            )


@checked
class Denoiser(Module):
    r"""Remove white Gaussian noise of known standard deviation from grey images of any size.

    The network N estimates the noise: :math:`D(y, \sigma) = y - N(y - \bar y, \sigma)`, with the
    mean :math:`\bar y` of the image. N has no biases, hence :math:`D(a y + b, a \sigma) =
    a D(y, \sigma) + b` for every a > 0 and b: images may be in any unit, with any offset. It was
    trained on linear light, for σ from 1/255 to 100/255 of the image's range.

    **Arguments**: `network`, a `DenoisingUNet`; by default the one that comes with the package.

    >>> denoiser = Denoiser()
    >>> denoiser(jnp.zeros((3, 20, 31)), 0.1).shape
    (3, 20, 31)
    """

    network: DenoisingUNet

    def __init__(self, network: DenoisingUNet | None = None):
        self.network = Denoiser.load(SHIPPED).network if network is None else network

    def save(self, path: str | os.PathLike[str], training: dict[str, Any] | None = None) -> Path:
        """Write the network, its options, and a record of its training: JSON."""
        sizes = dict(zip(("widths", "blocks"), self.network.shape, strict=True))
        description = {"kind": _KIND, "options": sizes, "training": training or {}}
        return write_arrays(path, self.network, description)

    @staticmethod
    @checked
    def load(path: str | os.PathLike[str]) -> "Denoiser":
        """Read what a training wrote; `path` may be "shipped".

        **Errors**: CheckpointError, one line, for a damaged file, one of another kind, and weights
        that are not finite; OSError for what cannot be read.
        """
        path = _SHIPPED_FILE if str(path) == SHIPPED else path
        description = network_description(path, _KIND)
        try:
            options = _options(description)
            like = eqx.filter_eval_shape(lambda key: create(options, key=key), jax.random.key(0))
        except Exception as error:  # whatever another's options bring about
            cause = f"{path}: options of another version ({of_error(error)})"
            raise CheckpointError(cause) from None
        like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), like)
        return Denoiser(read_weights(path, like))

    def __call__(self, image: Numbers, noise_std: Numbers) -> Float[Array, "*batch y x"]:
        """The denoised image.

        **Arguments**

        - `image`: (*batch, y, x); colours are a batch, each is denoised by itself.
        - `noise_std`: standard deviation of the noise, in the unit of the image; one number, or one
          for each image of the batch.

        **Errors**: ValueError or TypeError, one line, for an image of other dimensions, numbers
        that are not finite, and a noise_std that is not positive or does not fit the batch.
        """
        image, noise_std = _checked(image, noise_std)
        return _denoised(self.network, image, noise_std)


def _checked(image: Numbers, noise_std: Numbers) -> tuple[Array, Array]:
    wanted = "give finite numbers of shape (*batch, y, x)"
    image, noise_std = checks.array("image", image), checks.array("noise_std", noise_std)
    if image.ndim < 2 or 0 in image.shape:
        raise ValueError(f"image has shape {image.shape}; {wanted}, not empty")
    if not checks.is_traced(image) and not np.isfinite(np.asarray(image)).all():
        raise ValueError(f"image holds NaN or infinity; {wanted}")
    image = checks.as_array(image, floating=True)
    batch = image.shape[:-2]
    if noise_std.shape not in ((), batch):
        raise ValueError(
            f"noise_std has shape {noise_std.shape}; give one number, or one an image: {batch}"
        )
    noise_std = checks.positive_all("noise_std", noise_std.astype(image.dtype), "the image's unit")
    return image, jnp.broadcast_to(noise_std, batch)


@eqx.filter_jit
def _denoised(network: DenoisingUNet, image: Array, sigma: Array) -> Array:
    images = image.reshape(-1, *image.shape[-2:])
    centre = jnp.mean(images, axis=(1, 2))
    return denoised(network, images, sigma.reshape(-1), centre).reshape(image.shape)


def denoised(
    network: DenoisingUNet,
    images: Float[Array, "image y x"],
    sigma: Float[Array, " image"],
    centre: Float[Array, " image"],
) -> Float[Array, "image y x"]:
    """Images minus the noise that the network finds in them once their `centre` is taken out."""
    return images - jax.vmap(network)(images - centre[:, None, None], sigma)


def create(options: DenoiserOptions = DenoiserOptions(), *, key: Key) -> DenoisingUNet:
    """An untrained network, by a key or a seed, which finds no noise."""
    return DenoisingUNet(options.widths, options.blocks, key=random_key(key))


@dataclasses.dataclass(frozen=True)
class NetworkCard:
    """Options, pictures and scores of a denoiser's training.

    - `images`: names, sums and licences of the pictures by their use.
    - `scores`: loss of each check, on pictures held out; `cpu_seconds`: CPU time of the last
      training, s.
    """

    options: DenoiserOptions
    images: dict[str, tuple[Entry, ...]]
    scores: tuple[float, ...]
    cpu_seconds: float


def network_card(path: str | os.PathLike[str] = SHIPPED) -> NetworkCard:
    """Card of a network's file. **Errors**: as of `Denoiser.load`."""
    path = _SHIPPED_FILE if str(path) == SHIPPED else path
    description = network_description(path, _KIND)
    training = description["training"]
    try:
        images = from_json(training.get("images", {}))
        numbers = tuple(training.get("scores", ())), float(training.get("cpu_seconds", 0.0))
        return NetworkCard(_options(description), images, *numbers)
    except Exception as error:  # whatever another's card holds
        raise CheckpointError(f"{path}: card of another version ({of_error(error)})") from None


def _options(description: dict[str, Any]) -> DenoiserOptions:
    stored = description["options"]
    return DenoiserOptions(tuple(stored["widths"]), tuple(stored["blocks"]))
