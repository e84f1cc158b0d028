"""PSFs cut to a smaller window: the same residuals near an image, and when they stay whole."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.cut_psf import with_cut_psfs
from thincam_jax.reconstruction.problem import InverseProblem, residuals

SENSOR, FIELD = (60, 80), (48, 70)


def psf(spread: float) -> np.ndarray:
    """A random mask's shadow of 31×41 samples in weak light at all differences."""
    random = np.random.default_rng(1)
    whole = spread * random.random([s + f - 1 for s, f in zip(SENSOR, FIELD, strict=True)])
    whole[38:69, 54:95] += random.random((31, 41))
    return whole


def problem_of(kernel: np.ndarray, deviation: float = 1e-3) -> tuple[InverseProblem, Any]:
    """A problem of one capture of two colours, and an image near the scene."""
    random = np.random.default_rng(2)
    operator = CropConvolution(
        jnp.asarray(kernel[None, None], "float32"), 1.0, SENSOR, FIELD, summed=1
    )
    scene = jnp.asarray(random.random((2, 1, *FIELD)), "float32")
    capture = np.asarray(operator(scene))
    noise = deviation * capture.std()
    capture = capture + noise * random.standard_normal(capture.shape).astype(np.float32)
    near = scene * jnp.asarray(1 + 0.05 * random.standard_normal(scene.shape), "float32")
    return InverseProblem(operator, jnp.asarray(capture), weights=[1 / noise**2]), near


def window_of(problem: InverseProblem) -> tuple[int, int]:
    (operator,) = problem.operators
    assert isinstance(operator, CropConvolution)
    return operator.window


def test_residuals_stay_those_of_the_whole_psf_near_the_image():
    problem, near = problem_of(psf(1e-5))
    cut = with_cut_psfs(problem, near)
    small, whole = window_of(cut), window_of(problem)
    assert small[0] < whole[0] and small[1] < whole[1]
    before, after = (np.asarray(residuals(one, near)[0]) for one in (problem, cut))
    scale = np.abs(problem.captures[0]).max()
    np.testing.assert_allclose(after, before, atol=2e-6 * scale)
    other = near + 0.05 * jnp.asarray(np.random.default_rng(3).random(near.shape), "float32")
    before, after = (np.asarray(residuals(one, other)[0]) for one in (problem, cut))
    lost = problem.operators[0](other) - cut.operators[0](other)  # what cutting alone would miss
    assert np.std(after - before) < 0.02 * np.sqrt(np.mean(np.square(lost)))


@pytest.mark.parametrize("change", ["light everywhere", "hardly any noise"])
def test_psfs_stay_whole(change):
    """With light beyond any cut, and where it would be far above the noise."""
    light, noise = {"light everywhere": (1e-2, 1e-3), "hardly any noise": (1e-5, 1e-7)}[change]
    problem, near = problem_of(psf(light), noise)
    assert with_cut_psfs(problem, near) is problem


def test_each_axis_is_cut_by_its_own_light():
    kernel = psf(0.0)
    kernel[:, 54:95] += 1e-3
    problem, near = problem_of(kernel)
    cut, whole = window_of(with_cut_psfs(problem, near)), window_of(problem)
    assert cut[0] == whole[0] and cut[1] < whole[1]
