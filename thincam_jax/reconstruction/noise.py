"""How noisy a capture is, from the capture alone."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks


def estimate_noise(
    capture: Float[Array, "*batch y x"], valid: Bool[Array, "*batch y x"] | None = None
) -> Float[Array, "*batch"]:
    r"""Standard deviation of white noise in an image, from its finest diagonal detail.

    .. math:: \sigma = \mathrm{median}\,|g_{00} - g_{01} - g_{10} + g_{11}| / (2 \cdot 0.6745)

    over 2×2 blocks (Donoho and Johnstone, Biometrika 81, 425, 1994, with the Haar wavelet). A
    lensless capture is smooth at this scale; where fringes are as fine as pixels the estimate is
    too high. Blocks with a pixel that is not `valid` do not count. It is 0 where no block is left.
    """
    rows, columns = (n - n % 2 for n in capture.shape[-2:])
    if rows < 2 or columns < 2:
        return jnp.zeros(capture.shape[:-2], capture.dtype)
    blocks = _blocks(capture, rows, columns)
    detail = jnp.abs(blocks[..., 0, 0] - blocks[..., 0, 1] - blocks[..., 1, 0] + blocks[..., 1, 1])
    if valid is not None:
        whole = jnp.all(_blocks(valid, rows, columns), axis=(-2, -1))
        detail = jnp.where(whole, detail, jnp.nan)
    median = jnp.nanmedian(detail, axis=(-2, -1))
    return jnp.where(jnp.isnan(median), 0, median) / (2 * 0.6745)


def _blocks(image, rows: int, columns: int):
    """The image in 2×2 blocks: (…, row, column, 2, 2)."""
    even = image[..., :rows, :columns]
    apart = even.reshape(*even.shape[:-2], rows // 2, 2, columns // 2, 2)
    return jnp.swapaxes(apart, -3, -2)


def estimate_variance(
    captures: Sequence[Float[Array, "*batch y x"]] | Float[Array, "capture *batch y x"],
    valid: Sequence[Bool[Array, "*batch y x"]] | Bool[Array, "capture *batch y x"] | None = None,
) -> Float[Array, " capture"]:
    """Variance of each capture's noise, averaged over its batch.

    A capture without any is taken to have noise of a thousandth of the root mean square of all, so
    that what depends on the estimate scales with the captures; of 1 if they are all zero.
    """
    masks = [None] * len(captures) if valid is None else valid
    pairs = zip(captures, masks, strict=True)
    found = jnp.stack([jnp.mean(estimate_noise(c, m) ** 2) for c, m in pairs])
    least = 1e-6 * jnp.mean(jnp.stack([jnp.mean(c**2) for c in captures]))
    return jnp.where(found > 0, found, jnp.where(least > 0, least, 1))


def given_variances(
    noise_variance, captures: Sequence[Float[Array, "..."]] | Float[Array, "capture ..."]
) -> Float[Array, " capture"]:
    """The variance given, of each capture, averaged over its batch."""
    count = len(captures)
    each = jnp.asarray(noise_variance, captures[0].dtype)
    if not checks.is_traced(each) and not bool(jnp.all((each >= 0) & jnp.isfinite(each))):
        raise ValueError(
            f"noise_variance = {noise_variance} is negative or not finite; give variances in the "
            "captures' units squared, or none to have them estimated"
        )
    if each.ndim and each.shape[0] != count:
        raise ValueError(
            f"noise_variance has shape {each.shape}; give one number or one for each of the "
            f"{count} captures"
        )
    each = jnp.broadcast_to(each.reshape(each.shape or (1,)), (count, *each.shape[1:]))
    return jnp.mean(each.reshape(count, -1), axis=1)
