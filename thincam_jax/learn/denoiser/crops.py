"""Noisy crops of pictures, and the loss by which a network learns to denoise them."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.learn.denoiser.network import LEAST, MOST, denoised
from thincam_jax.learn.denoiser.unet import DenoisingUNet

# ln of the exponents and factors that change the contrast of a crop.
_GAMMA, _GAIN = (-0.9, 0.3), (-0.8, 0.5)
# Standard deviation of an offset subtracted from a crop beside its mean: in a large image, local
# means differ from the mean of the whole.
_OFFSET = 0.15
# Added to MSE/σ²: the root's slope stays finite.
_LEAST_ERROR = 1e-4


class Crops(eqx.Module):
    """Noisy crops and what is to be found in them; see `denoised` for `centre`."""

    clean: Float[Array, "image y x"]
    noisy: Float[Array, "image y x"]
    sigma: Float[Array, " image"]
    centre: Float[Array, " image"]


@eqx.filter_jit
def draw_crops(
    tiles: Float[Array, "tile side side 3"], batch: int, crop: int, key: PRNGKeyArray
) -> Crops:
    """Crops of tiles, turned and mirrored, in changed contrast, with noise of all levels.

    Grey is a random mixture of the three colours. Half of the crops are linear light, the others
    powers of it. ln σ is uniform, stratified over the batch.
    """
    keys = iter(jax.random.split(key, 12))
    count, side = tiles.shape[:2]
    chosen = jax.random.randint(next(keys), (batch,), 0, count)
    corner = jax.random.randint(next(keys), (batch, 2), 0, side - crop + 1)

    def cut(tile, place):
        return jax.lax.dynamic_slice(tiles, (tile, *place, 0), (1, crop, crop, 3))[0]

    mixture = jax.random.dirichlet(next(keys), jnp.ones(3, tiles.dtype), (batch,), tiles.dtype)
    clean = jnp.einsum("byxc,bc->byx", jax.vmap(cut)(chosen, corner), mixture, precision="highest")
    turned = jax.random.bernoulli(next(keys), shape=(3, batch, 1, 1))
    clean = jnp.where(turned[0], clean[:, ::-1], clean)
    clean = jnp.where(turned[1], clean[:, :, ::-1], clean)
    clean = jnp.where(turned[2], jnp.swapaxes(clean, 1, 2), clean)

    def uniform(low: float, high: float):
        return jax.random.uniform(next(keys), (batch, 1, 1), tiles.dtype, low, high)

    is_linear = jax.random.bernoulli(next(keys), shape=(batch, 1, 1))
    # A power below 1 has no finite slope at 0, which nothing is differentiated by here.
    power = jnp.where(is_linear, jnp.ones((), tiles.dtype), jnp.exp(uniform(*_GAMMA)))
    clean = clean**power * jnp.exp(uniform(*_GAIN))
    strata = jnp.arange(batch, dtype=tiles.dtype) + uniform(0.0, 1.0)[:, 0, 0]
    spread = math.log(MOST / LEAST) / batch
    sigma = LEAST * jnp.exp(spread * strata)
    noise = jax.random.normal(next(keys), clean.shape, tiles.dtype)
    noisy = clean + sigma[:, None, None] * noise
    offset = _OFFSET * jax.random.normal(next(keys), (batch,), tiles.dtype)
    return Crops(clean, noisy, sigma, jnp.mean(noisy, axis=(1, 2)) + offset)


def loss(network: DenoisingUNet, crops: Crops) -> tuple[Array, dict[str, Array]]:
    """Mean of RMSE/√σ: what good denoisers leave grows about as √σ, so all levels weigh the same.

    A logarithm of the error would weigh flat crops as much as those with detail.
    """
    found = denoised(network, crops.noisy, crops.sigma, crops.centre)
    error = jnp.mean((found - crops.clean) ** 2, axis=(1, 2)) / crops.sigma**2
    value = jnp.mean(jnp.sqrt((error + _LEAST_ERROR) * crops.sigma))
    return value, {"error": jnp.mean(error)}
