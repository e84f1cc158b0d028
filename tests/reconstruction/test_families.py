"""The families behind `reconstruct`: regularisers other than total variation."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import rig

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.reconstruction import psf_problem, solve_proximal
from thincam_jax.reconstruction.regularised import middle
from thincam_jax.reconstruction.sparsity import Cosines, Sparsity
from thincam_jax.reconstruction.wavelet import Wavelet

SHAPE = (40, 41)


def cosines(noise=0.02):
    """A scene of three cosines as seen through a blur, the kernel, and the scene."""
    kernel = rig.picture((9, 10)) - 0.25
    kernel /= kernel.sum()
    shape = (SHAPE[0] + 8, SHAPE[1] + 9)
    details = np.zeros(shape)
    details[0, 0], details[2, 3], details[5, 1], details[0, 7] = 60.0, 8.0, -6.0, 5.0
    truth = np.asarray(Cosines().synthesise(jnp.asarray(details)))
    seen = scipy.signal.convolve2d(truth, kernel, mode="valid")
    seen += noise * np.random.default_rng(2).normal(size=seen.shape)
    return jnp.asarray(seen)[None], jnp.asarray(kernel)[None], truth


@pytest.mark.thorough
@pytest.mark.parametrize("method", [pytest.param("fista", marks=pytest.mark.thorough), "twist"])
def test_a_regulariser_takes_the_place_of_total_variation(method):
    """Few cosines are found better as such than as an image of few edges, with the same τ."""
    captures, kernel, truth = cosines()
    settings = {"noise_variance": 4e-4, "field_shape": truth.shape}
    basis = Sparsity(Cosines())
    sparse = tc.reconstruct(captures, kernel, method=method, regulariser=basis, **settings)
    edges = tc.reconstruct(captures, kernel, method="admm_tv", **settings)
    assert sparse.tau == edges.tau == 2.0
    assert relative_l2(sparse.image, truth) < 0.6 * relative_l2(edges.image, truth)


def test_it_is_that_of_the_solver():
    captures, kernel, truth = cosines()
    basis = Sparsity(Wavelet("haar", levels=2))
    found = tc.reconstruct(
        captures, kernel, method="fista", regulariser=basis, tau=1.0, iterations=20, tolerance=0.0
    )
    problem = psf_problem(captures, kernel, tau=1.0)
    blank = jnp.zeros(problem.image_shape)
    direct = solve_proximal(problem, regulariser=basis, image=blank, iterations=20, tolerance=0.0)
    np.testing.assert_allclose(found.image, middle(direct.image[0, 0], SHAPE), rtol=1e-12)
    assert found.history[-1].objective == pytest.approx(direct.history[-1].objective)
