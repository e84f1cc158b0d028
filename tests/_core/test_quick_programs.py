"""Programs that are compiled quickly: the same values, also as a part of others."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from helpers import compilations
from thincam_jax._core.quick_programs import quickly_compiled


@functools.partial(quickly_compiled, static_argnames="power")
def norm(values, power=2):
    """Σ |v|^p."""
    return jnp.sum(jnp.abs(values) ** power)


def test_values_alone_and_within_other_programs():
    values = jnp.asarray(np.random.default_rng(0).normal(size=(5, 7)))
    for power in (2, 3):
        expected = np.sum(np.abs(np.asarray(values)) ** power)
        one = functools.partial(norm, power=power)
        np.testing.assert_allclose(one(values), expected, rtol=1e-13)
        np.testing.assert_allclose(jax.jit(one)(values), expected, rtol=1e-13)
        # Of values that are known while another program is traced, too.
        known = jax.jit(lambda scale, one=one: scale * one(values))(2.0)
        np.testing.assert_allclose(known, 2 * expected, rtol=1e-13)
        rows = np.sum(np.abs(np.asarray(values)) ** power, axis=1)
        np.testing.assert_allclose(jax.vmap(one)(values), rows, rtol=1e-13)
    np.testing.assert_allclose(jax.grad(norm)(values), 2 * values, rtol=1e-13)


def test_new_values_compile_nothing():
    norm(np.ones((3, 4)))
    assert compilations(lambda: norm(np.full((3, 4), 2.0))) == 0
    assert norm.__doc__ == "Σ |v|^p."
