"""Random keys, or the seeds of them."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from thincam_jax._core.checks import shown

Key = PRNGKeyArray | int


def random_key(key: Key) -> PRNGKeyArray:
    """The key itself, or that of a seed, `jax.random.key(seed)`."""
    if isinstance(key, int | np.integer) and not isinstance(key, bool) and 0 <= key < 2**64:
        return jax.random.key(key)
    if isinstance(key, jax.Array):
        if jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key) or key.dtype == "uint32":
            return key
    raise TypeError(f"key is {shown(key)}; give a seed, 0 or more, or jax.random.key(seed)")
