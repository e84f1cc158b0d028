"""The network of the denoiser: a residual U-Net without biases."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.learn.refocusing.unet import blocks_to_channels, channels_to_blocks, convolved

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
