"""Random keys, or the seeds of them."""

import jax
from jaxtyping import PRNGKeyArray

Key = PRNGKeyArray | int


def random_key(key: Key) -> PRNGKeyArray:
    """The key itself, or that of a seed, `jax.random.key(seed)`."""
    return jax.random.key(key) if isinstance(key, int) else key
