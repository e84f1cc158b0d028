r"""Training loss of the U-Nets of a refocusing network."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.learn.refocusing.cameras import Stand
from thincam_jax.learn.refocusing.network import RefocusNetwork, normalised, prepared, read_images
from thincam_jax.learn.refocusing.scenes import Batch
from thincam_jax.learn.refocusing.unet import UNet

Parts = dict[str, Float[Array, ""]]

# Of the parts in the loss.
_SHARES = {"focus": 1.0, "all_in_focus": 0.3, "planes": 0.1, "distance": 0.1}
_LEAST = 1e-5  # of an image's mean square: an error below it counts for nothing


class Examples(eqx.Module):
    """Input and target of a U-Net for one scene or, (element, …), for many.

    - `images`: images by `prepared`, for planes at `stand`.
    - `stack`: light of the planes; what stands between two is shared out between them.
    - `image`, `all_in_focus`: in units of the scene's mean; `inverse`: 1/t, 1/mm.
    """

    images: Float[Array, "*element image y x"]
    stand: Stand
    stack: Float[Array, "*element plane y x"]
    image: Float[Array, "*element y x"]
    all_in_focus: Float[Array, "*element y x"]
    inverse: Float[Array, "*element y x"]

    def mirrored(self, rows: Array, columns: Array) -> "Examples":
        """Upside down where `rows` is true, left to right where `columns` is.

        Masks and sensors are the same in a mirror, so that these are captures, too.
        """

        def turned(leaf):
            leaf = jnp.where(rows, leaf[..., ::-1, :], leaf)
            return jnp.where(columns, leaf[..., ::-1], leaf)

        names = ("images", "stack", "image", "all_in_focus", "inverse")
        return replace(self, **{name: turned(getattr(self, name)) for name in names})


@eqx.filter_jit
def examples(network: RefocusNetwork, batch: Batch) -> Examples:
    """Input and target of a network's last U-Net for a batch."""
    return jax.vmap(lambda one: _example(network, one))(batch)


def _example(network: RefocusNetwork, one: Batch) -> Examples:
    planes, stack = network.planes, None
    mean, capture, sigma = normalised(planes, one.capture, one.deviation)
    stand = network.camera.stand(one.commanded)
    given = (capture, sigma, stand, planes.spectra_at(1 / stand.inverse))
    last = len(network.weights.prior) - 1
    for number in range(last):
        images = prepared(network, number, stack, given)
        stack = read_images(network.weights.prior[number], images, stand).stack
    unit = jnp.where(mean > 0, mean, 1)
    shares = stand.splat(one.scene.inverse)  # (plane, layer, part)
    return Examples(
        prepared(network, last, stack, given),
        stand,
        jnp.einsum("klp,lpyx->kyx", shares, one.emission, precision="highest") / unit,
        one.image / unit,
        one.all_in_focus / unit,
        one.inverse,
    )


def loss(prior: UNet, given: Examples) -> tuple[Float[Array, ""], Parts]:
    r"""The loss of a U-Net, differentiable in it, and its parts, each a mean over the examples.

    - `focus`, `all_in_focus`: ½ ln of the mean squared error over the image's mean square; a
      decrease by 0.115 is 1 dB, however bright or hard the scene is.
    - `planes`: that of the stack.
    - `distance`: −ln of the Laplace density of 1/t at each pixel, in steps of the planes, with the
      error that the network expects.
    """
    parts = jax.vmap(lambda one: _parts(prior, one))(given)
    parts = {name: jnp.mean(part) for name, part in parts.items()}
    total = sum((_SHARES[name] * part for name, part in parts.items()), jnp.zeros(()))
    return total.astype(given.images.dtype), parts


def _parts(prior: UNet, one: Examples) -> Parts:
    """Parts of the loss of one element."""
    stand = one.stand
    cleaned = read_images(prior, one.images, stand)
    step = (stand.inverse[0] - stand.inverse[-1]) / (stand.inverse.size - 1)
    error = jnp.abs(cleaned.inverse_distance(stand) - one.inverse) / step
    spread = cleaned.spread
    return {
        "focus": relative_error(cleaned.image, one.image),
        "all_in_focus": relative_error(cleaned.all_in_focus, one.all_in_focus),
        "planes": relative_error(cleaned.stack, one.stack),
        "distance": jnp.mean(error / spread + jnp.log(spread)),
    }


def relative_error(image: Array, target: Array) -> Float[Array, ""]:
    """½ ln of the mean squared error over the target's mean square."""
    size = jnp.mean(target**2)
    ratio = jnp.mean((image - target) ** 2) / jnp.where(size > 0, size, 1)
    return jnp.log(ratio + _LEAST) / 2
