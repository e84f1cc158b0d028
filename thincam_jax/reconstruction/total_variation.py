r"""Total variation of an image, its proximal map, and the differences it is made of."""

import functools
from collections.abc import Sequence
from typing import ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.precision import flat_root
from thincam_jax._core.quantity import choice, quantity
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image

Kind = Literal["isotropic", "anisotropic"]
Coupling = Literal["none", "joint", "opponent"]

# Red, green, blue to grey, red-green, yellow-blue; orthonormal, so that white noise stays white.
OPPONENT = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])


class TotalVariation(AbstractRegulariser):
    r"""Total variation of images (*batch, channel, plane, y, x), and how its parts are joined.

    .. math:: TV(f) = \sum_{c,\mathbf r} w_c\, \|(\partial_y f_c, \partial_x f_c,
        \delta\, \partial_z f_c)(\mathbf r)\|

    with forward differences (thesis Eq 5.11, Ψ). No difference leaves the image: its border costs
    nothing.

    **Arguments**

    - `kind`: "isotropic" takes the length of the vector of differences, "anisotropic" the sum of
      their absolute values, which favours edges along the axes.
    - `coupling`: coupling of colours. "none": channels independent. "joint": one length over all
      channels (vectorial total variation), so that edges lie in the same place. "opponent" (three
      channels): the sum of the variations of grey and of the two colour differences. Noise of three
      channels is averaged in grey, and colours vary less than grey in most scenes.
    - `depth_weight`: δ, the weight of a difference between planes; 0 leaves planes independent.
    - `chroma_weight`: weight of the two colour differences with "opponent".

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 3, 24, 32)), tc.Psfs(psf[None, None]))
    colours = tc.reconstruction.TotalVariation(coupling="joint")  # edges of all channels at once
    result = tc.reconstruct(recording, tc.AdmmTV(variation=colours, iterations=10))
    ```

    **See also**: `AdmmTV`.
    """

    # The proximal map of an image takes inner iterations.
    orthonormal: ClassVar[bool] = False
    kind: Kind = eqx.field(default="isotropic", converter=choice(get_args(Kind)), static=True)
    coupling: Coupling = eqx.field(
        default="none", converter=choice(get_args(Coupling)), static=True
    )
    depth_weight: Float[Array, ""] = eqx.field(
        default=0.0, converter=quantity("parts of one", non_negative=True), kw_only=True
    )
    chroma_weight: Float[Array, ""] = eqx.field(
        default=1.5, converter=quantity("parts of one", non_negative=True), kw_only=True
    )

    def __call__(self, image: Image) -> Float[Array, "*batch"]:
        """The total variation."""
        rotated = self._rotate(self.analyse(image))
        lengths = self._length(rotated) * self._channel_weights(image.dtype)
        axes = (-4, -3, -2, -1)
        return jnp.sum(lengths, axis=axes)

    def analyse(self, image: Image) -> tuple[Image, ...]:
        """The differences inside of the image."""
        return _inside(differences(image, self.depth_weight))

    def synthesise(self, parts: tuple[Image, ...]) -> Image:
        """The transpose of `analyse`."""
        return differences_adjoint(_inside(parts), self.depth_weight)

    def squared_norm(self, dtype: DTypeLike) -> Float[Array, ""]:
        """Each of the directions takes differences of two samples: at most 2² = 4."""
        return 8 + 4 * self.depth_weight.astype(dtype) ** 2

    def shrink(self, parts: tuple[Image, ...], step: Number) -> tuple[Image, ...]:
        """The slopes u that minimise step·TV + ½‖u − parts‖²: each vector shortened by `step`."""
        rotated = self._rotate(parts)
        weights = self._channel_weights(parts[0].dtype)
        channels, step = self.coupling == "joint", step * weights
        if self.kind == "isotropic":
            shrunk = _shortened(rotated, step, channels)
        else:
            shrunk = tuple(_shortened((s,), step, channels)[0] for s in rotated)
        return self._rotate(shrunk, back=True)

    def _length(self, slopes):
        """Lengths of the joined vectors; summed over directions if anisotropic."""
        channels = self.coupling == "joint"
        if self.kind == "isotropic":
            return _norm(slopes, channels=channels)
        return sum(_norm((s,), channels=channels) for s in slopes)

    def _rotate(self, slopes, *, back: bool = False):
        if self.coupling != "opponent":
            return slopes
        channels = slopes[0].shape[-4]
        if channels != 3:
            raise ValueError(
                f'coupling "opponent" is for 3 colour channels, the image has {channels}; '
                'use "joint" or "none"'
            )
        matrix = jnp.asarray(OPPONENT.T if back else OPPONENT, dtype=slopes[0].dtype)
        return tuple(
            jnp.einsum("dc,...czyx->...dzyx", matrix, s, precision="highest") for s in slopes
        )

    def _channel_weights(self, dtype):
        if self.coupling != "opponent":
            return jnp.ones((1, 1, 1, 1), dtype)
        chroma = self.chroma_weight.astype(dtype)
        return jnp.stack([jnp.ones((), dtype), chroma, chroma])[:, None, None, None]


def differences(
    image: Float[Array, "*batch plane y x"], depth_weight: Number
) -> tuple[Float[Array, "*batch plane y x"], ...]:
    """Forward differences along y and x, round the window's end, and between planes.

    The last plane's difference is zero; without several planes there is none.
    """
    down = jnp.roll(image, -1, axis=-2) - image
    right = jnp.roll(image, -1, axis=-1) - image
    if image.shape[-3] == 1:
        return down, right
    behind = jnp.diff(image, axis=-3, append=image[..., -1:, :, :])
    return down, right, jnp.asarray(depth_weight, image.dtype) * behind


def differences_adjoint(
    slopes: tuple[Float[Array, "*batch plane y x"], ...], depth_weight: Number
) -> Float[Array, "*batch plane y x"]:
    """The transpose of `differences`."""
    down, right, *depth = slopes
    image = (jnp.roll(down, 1, axis=-2) - down) + (jnp.roll(right, 1, axis=-1) - right)
    for behind in depth:
        behind = jnp.asarray(depth_weight, image.dtype) * behind[..., :-1, :, :]
        margins = [(0, 0)] * (behind.ndim - 3)
        before = jnp.pad(behind, [*margins, (1, 0), (0, 0), (0, 0)])
        image = image + before - jnp.pad(behind, [*margins, (0, 1), (0, 0), (0, 0)])
    return image


def field_masks(
    field_shape: tuple[int, int], window: tuple[int, int], corner: tuple[int, int] = (0, 0)
) -> tuple[tuple[Array, Array], ...]:
    """Where the differences down, right and behind lie inside of the field, on a window.

    A column and a row of booleans each, both of which hold there: no mask of the window's size
    becomes a constant, and none is kept for a gradient.
    """
    rows, columns = (np.arange(n) - c for n, c in zip(window, corner, strict=True))
    height, width = field_shape
    y, y_down = (jnp.asarray((rows >= 0) & (rows < n))[:, None] for n in (height, height - 1))
    x, x_right = (jnp.asarray((columns >= 0) & (columns < n)) for n in (width, width - 1))
    return (y_down, x), (y, x_right), (y, x)


def within_field(slopes: Sequence[Float[Array, "..."]], masks: Sequence[tuple[Array, Array]]):
    """Slopes with those that leave the field set to zero."""
    lines = [[m.astype(s.dtype) for m in pair] for pair, s in zip(masks, slopes, strict=False)]
    return tuple(s * y * x for s, (y, x) in zip(slopes, lines, strict=True))


def _inside(slopes):
    shape = slopes[0].shape[-2:]
    return within_field(slopes, field_masks(shape, shape))


def _norm(slopes, *, channels: bool):
    """Length of vectors of slopes, over the channel axis too if these are joined."""
    squared = sum(s * s for s in slopes)
    if channels:
        squared = jnp.sum(squared, axis=-4, keepdims=True)
    return flat_root(squared)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _shortened(slopes, step, channels: bool):
    """Vectors of slopes, over the channel axis too if these are joined, shortened by `step`."""
    kept, _, _ = _kept(slopes, step, channels)
    return tuple(s * kept for s in slopes)


@functools.partial(_shortened.defjvp, symbolic_zeros=True)
def _shortened_slope(channels: bool, primals, tangents):
    r"""Slope k ds + (1 − k) n (n·ds) − n dstep, of the part k that is kept and the direction n.

    Written out so that a gradient holds k and n alone: the compiler's own holds four times as much.
    """
    (slopes, step), (turns, change) = primals, tangents
    kept, longer, length = _kept(slopes, step, channels)
    direction = tuple(jnp.where(longer, s / length, 0) for s in slopes)
    turns = [
        jnp.zeros_like(s) if isinstance(t, SymbolicZero) else t
        for t, s in zip(turns, slopes, strict=True)
    ]
    along = sum(n * t for n, t in zip(direction, turns, strict=True))
    if channels:
        along = jnp.sum(along, axis=-4, keepdims=True)
    out = tuple(
        kept * t + n * (along - kept * along) for n, t in zip(direction, turns, strict=True)
    )
    if not isinstance(change, SymbolicZero):
        out = tuple(t - n * change for n, t in zip(direction, out, strict=True))
    return tuple(s * kept for s in slopes), out


def _kept(slopes, step, channels: bool):
    """The part of a vector that shortening leaves, max(0, 1 − step/length).

    With where it leaves any, and the length there (1 elsewhere).
    """
    whole = _norm(slopes, channels=channels)
    longer = whole > step
    length = jnp.where(longer, whole, 1)
    return jnp.where(longer, 1 - step / length, 0), longer, length
