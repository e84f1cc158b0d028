"""How noisy a capture is, from the capture alone."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def estimate_noise(capture: Float[Array, "*batch y x"]) -> Float[Array, "*batch"]:
    r"""Standard deviation of white noise in an image, from its finest diagonal detail.

    .. math:: \sigma = \mathrm{median}\,|g_{00} - g_{01} - g_{10} + g_{11}| / (2 \cdot 0.6745)

    over 2×2 blocks (Donoho and Johnstone, Biometrika 81, 425, 1994, with the Haar wavelet). A
    lensless capture is smooth at this scale; where fringes are as fine as pixels the estimate is
    too high. It is 0 for an image of fewer than 2×2 pixels.
    """
    rows, columns = (n - n % 2 for n in capture.shape[-2:])
    if rows < 2 or columns < 2:
        return jnp.zeros(capture.shape[:-2], capture.dtype)
    even = capture[..., :rows, :columns]
    left, right = even[..., ::2], even[..., 1::2]
    difference = left - right
    detail = difference[..., ::2, :] - difference[..., 1::2, :]
    return jnp.median(jnp.abs(detail), axis=(-2, -1)) / (2 * 0.6745)


def estimate_variance(captures: Float[Array, "capture *batch y x"]) -> Float[Array, " capture"]:
    """Variance of each capture's noise, averaged over its batch.

    A capture without any is taken to have noise of a thousandth of the root mean square of all, so
    that what depends on the estimate scales with the captures; of 1 if they are all zero.
    """
    count = captures.shape[0]
    found = jnp.mean(estimate_noise(captures).reshape(count, -1) ** 2, axis=1)
    least = 1e-6 * jnp.mean(captures**2)
    return jnp.where(found > 0, found, jnp.where(least > 0, least, 1))
