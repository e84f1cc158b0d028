r"""What a refocusing network is trained for."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.learn.refocusing.network import (
    RefocusNetwork,
    explain,
    focused,
    inverse_distance,
    mapped,
)
from thincam_jax.learn.refocusing.scenes import Batch

Parts = dict[str, Float[Array, ""]]

# Of the parts in the loss.
_SHARES = {"focus": 1.0, "all_in_focus": 0.3, "planes": 0.1, "distance": 0.1}
_LEAST = 1e-5  # of an image's mean square: an error below it counts for nothing


def loss(network: RefocusNetwork, batch: Batch) -> tuple[Float[Array, ""], Parts]:
    r"""The loss of a batch, differentiable in the network, and its parts, each a mean.

    - `focus`, `all_in_focus`: ½ ln of the mean squared error over the image's mean square; a
      decrease by 0.115 is 1 dB, however bright or hard the scene is.
    - `planes`: the same of the stack against the light of the planes, which a scene between two
      planes shares out between them.
    - `distance`: −ln of the Laplace density of 1/t at each pixel, in steps of the planes, with the
      error that the network expects.
    """
    parts = jax.vmap(lambda one: _parts(network, one))(batch)
    parts = {name: jnp.mean(part) for name, part in parts.items()}
    total = sum((_SHARES[name] * part for name, part in parts.items()), jnp.zeros(()))
    return total.astype(batch.capture.dtype), parts


def _parts(network: RefocusNetwork, one: Batch) -> Parts:
    """Of one element."""
    planes = network.planes
    explained = explain(network, one.capture, one.deviation)
    maps = mapped(network, explained)
    mean = explained.mean
    unit = jnp.where(mean > 0, mean, 1)
    image = focused(network, explained, one.commanded)
    shares = planes.splat(one.scene.inverse)  # (plane, layer, part)
    stack = jnp.einsum("klp,lpyx->kyx", shares, one.emission) / unit
    error = jnp.abs(inverse_distance(network, maps) - one.inverse) / network.camera.step
    return {
        "focus": relative_error(image, one.image / unit),
        "all_in_focus": relative_error(maps.all_in_focus, one.all_in_focus / unit),
        "planes": relative_error(explained.stack, stack),
        "distance": jnp.mean(error / maps.spread + jnp.log(maps.spread)),
    }


def relative_error(image: Array, target: Array) -> Float[Array, ""]:
    """½ ln of the mean squared error over the target's mean square."""
    size = jnp.mean(target**2)
    ratio = jnp.mean((image - target) ** 2) / jnp.where(size > 0, size, 1)
    return jnp.log(ratio + _LEAST) / 2
