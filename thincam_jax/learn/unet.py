"""A small U-Net of plain 3×3 convolutions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class Convolution(eqx.Module):
    """A 3×3 convolution with zeros beside the image, on (channel, y, x)."""

    weight: Float[Array, "out in 3 3"]
    bias: Float[Array, "out 1 1"]

    def __init__(self, inputs: int, outputs: int, *, gain: float = 1.0, key: PRNGKeyArray):
        spread = gain * (2 / (9 * inputs)) ** 0.5  # He: keeps the variance through a ReLU
        self.weight = spread * jax.random.normal(key, (outputs, inputs, 3, 3))
        self.bias = jnp.zeros((outputs, 1, 1))

    def __call__(self, image: Float[Array, "in y x"]) -> Float[Array, "out y x"]:
        return convolved(image, self.weight) + self.bias.astype(image.dtype)


class ResidualConvolutions(eqx.Module):
    """x + C₂ ReLU(C₁ x)."""

    first: Convolution
    second: Convolution

    def __init__(self, channels: int, *, key: PRNGKeyArray):
        first, second = jax.random.split(key)
        self.first = Convolution(channels, channels, key=first)
        self.second = Convolution(channels, channels, gain=0.3, key=second)

    def __call__(self, image: Float[Array, "c y x"]) -> Float[Array, "c y x"]:
        return image + self.second(jax.nn.relu(self.first(image)))


class UNet(eqx.Module):
    """U-Net from images (input, y, x) to images (output, y, x); untrained it gives zeros.

    Blocks of 2×2 pixels become channels first, and pixels again at the end, so that the widest
    convolutions run on a quarter of the pixels. Each level halves the resolution by averaging; on
    the way back it is repeated and added. Sides that do not halve are padded by repeating the edge.

    **Arguments**: `inputs`, `outputs`; `widths`, channels of the levels from the finest.
    """

    enter: Convolution
    down: tuple[Convolution, ...]
    before: tuple[ResidualConvolutions, ...]
    after: tuple[ResidualConvolutions, ...]
    up: tuple[Convolution, ...]
    leave: Convolution

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...], *, key: PRNGKeyArray):
        keys = iter(jax.random.split(key, 4 * len(widths)))
        pairs = list(zip(widths[:-1], widths[1:], strict=True))
        self.enter = Convolution(4 * inputs, widths[0], key=next(keys))
        self.down = tuple(Convolution(a, b, key=next(keys)) for a, b in pairs)
        self.up = tuple(Convolution(b, a, key=next(keys)) for a, b in pairs)
        self.before = tuple(ResidualConvolutions(n, key=next(keys)) for n in widths)
        self.after = tuple(ResidualConvolutions(n, key=next(keys)) for n in widths[:-1])
        self.leave = Convolution(widths[0], 4 * outputs, gain=0.0, key=next(keys))

    def __call__(self, images: Float[Array, "input y x"]) -> Float[Array, "output y x"]:
        rows, columns = images.shape[-2:]
        factor = 2 ** (len(self.down) + 1)
        images = jnp.pad(images, ((0, 0), (0, -rows % factor), (0, -columns % factor)), "edge")
        x = self.before[0](self.enter(blocks_to_channels(images)))
        levels = []
        for down, before in zip(self.down, self.before[1:], strict=True):
            levels.append(x)
            x = before(jax.nn.relu(down(_halved(x))))
        for up, after, level in zip(self.up[::-1], self.after[::-1], levels[::-1], strict=True):
            x = after(level + _doubled(up(x)))
        return channels_to_blocks(self.leave(jax.nn.relu(x)))[:, :rows, :columns]


def convolved(x: Array, kernel: Array, stride: int = 1) -> Array:
    """Images (channel, y, x) by a kernel; one of 3×3 has zeros beside them."""
    padding = "SAME" if kernel.shape[-1] == 3 else "VALID"
    kernel = kernel.astype(x.dtype)
    return jax.lax.conv_general_dilated(
        x[None], kernel, (stride, stride), padding, precision="highest"
    )[0]


def parameter_count(tree: Any) -> int:
    """Numbers that are learnt."""
    return sum(x.size for x in jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)))


def blocks_to_channels(x: Float[Array, "c y x"]) -> Float[Array, "c4 y2 x2"]:
    """2×2 pixels of each channel as four channels, at half the resolution."""
    c, rows, columns = x.shape
    x = x.reshape(c, rows // 2, 2, columns // 2, 2)
    return jnp.transpose(x, (0, 2, 4, 1, 3)).reshape(4 * c, rows // 2, columns // 2)


def channels_to_blocks(x: Float[Array, "c4 y2 x2"]) -> Float[Array, "c y x"]:
    """The inverse of `blocks_to_channels`."""
    c, rows, columns = x.shape
    x = x.reshape(c // 4, 2, 2, rows, columns)
    return jnp.transpose(x, (0, 3, 1, 4, 2)).reshape(c // 4, 2 * rows, 2 * columns)


def _halved(x):
    c, rows, columns = x.shape
    return jnp.mean(x.reshape(c, rows // 2, 2, columns // 2, 2), axis=(2, 4))


def _doubled(x):
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
