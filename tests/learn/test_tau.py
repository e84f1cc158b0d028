"""The weight of a regularisation, learned: no other factor is better."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction.test_choose_tau import posed, solved

from thincam_jax.learn import learn_tau
from thincam_jax.reconstruction.problem import with_tau


@pytest.mark.thorough
def test_learning_finds_the_least_error_of_known_images():
    pairs = [posed(seed, tau=0.3) for seed in (0, 1)]
    problems, truths = zip(*pairs, strict=True)
    factor, course = learn_tau(problems, truths, steps=12, iterations=200)

    def error(factor):
        images = [solved(with_tau(p, p.tau * factor)) for p in problems]
        pairs = zip(images, truths, strict=True)
        return np.mean([float(jnp.mean((image - truth) ** 2)) for image, truth in pairs])

    assert course[0] == pytest.approx(error(1.0), rel=1e-3)
    assert course[-1] < 0.95 * course[0]
    assert error(float(factor)) < 1.02 * min(error(f) for f in np.geomspace(0.5, 20, 9))


def test_what_cannot_be_learned_from_is_refused():
    with pytest.raises(ValueError, match="0 problems, 1 images; give one for each"):
        learn_tau([], [jnp.zeros((1, 1, 3, 4))])
