"""Light that the model does not explain, where it is smooth."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from thincam_jax.imaging.operators import CropConvolution, Matrix
from thincam_jax.reconstruction import InverseProblem
from thincam_jax.reconstruction.problem import residuals
from thincam_jax.reconstruction.smooth_misfit import misfit_of
from thincam_jax.reconstruction.uniform_light import window_length

SENSOR, FIELD = (120, 131), (88, 93)
RNG = np.random.default_rng(2)
Y, X = np.meshgrid(*[np.linspace(-1, 1, n) for n in SENSOR], indexing="ij")


def problem_of(error=0.0, sigma=0.1, claimed=0.1, invalid=0.0):
    """A random code's capture with noise, and a smooth error relative to its mean."""
    kernel = jnp.asarray((RNG.random((1, 1, 20, 20)) < 0.3) / 100.0)
    odd = [(s + f - 1 - 20) % 2 for s, f in zip(SENSOR, FIELD, strict=True)]
    kernel = jnp.pad(kernel, [(0, 0), (0, 0), (0, odd[0]), (0, odd[1])])
    operator = CropConvolution(kernel, 1.0, SENSOR, FIELD, summed=1)
    image = jnp.asarray(RNG.random((1, 1, *FIELD)))
    light = operator(image)
    light = light * (1 + error * jnp.asarray(np.sin(1.7 * Y) + np.cos(2.9 * X)))
    capture = light + sigma * jnp.asarray(RNG.standard_normal(light.shape))
    valid = RNG.random(SENSOR) >= invalid
    return InverseProblem([operator], [capture], weights=[valid / claimed**2]), image


def test_it_is_that_of_a_direct_sum():
    problem, image = problem_of(error=0.2, invalid=0.05)
    found = misfit_of(problem, image)
    left = np.sqrt(problem.weights[0]) * np.asarray(residuals(problem, image)[0])[0]
    window = np.hanning(window_length(problem) + 2)[1:-1]
    window /= window.sum()
    low = np.pad(left, window.size)
    low = scipy.ndimage.convolve1d(low, window, axis=0, mode="constant")
    low = scipy.ndimage.convolve1d(low, window, axis=1, mode="constant")
    count = np.count_nonzero(problem.weights[0])
    smooth = np.sqrt(np.sum(low**2) / count) / np.sum(window**2)
    assert found.smooth == pytest.approx([smooth], rel=1e-4)  # it wraps round
    assert found.whole == pytest.approx(np.sqrt(np.sum(left**2) / count), rel=1e-9)


def test_noise_alone_is_not_smooth():
    """Nor is noise that is 30 times as strong as was claimed, which is said."""
    found = misfit_of(*problem_of())
    assert 0.5 < found.smooth[0] < 2 and found.whole == pytest.approx(1, abs=0.05)
    assert found.less_smooth(problem_of()[0]) is None and str(found) == ""
    wrong = misfit_of(*problem_of(claimed=0.1 / 30))
    assert wrong.smooth[0] > 15 and wrong.less_smooth(problem_of()[0]) is None
    assert "30." in str(wrong) or "29." in str(wrong)


def test_shading_counts_less():
    """What the high-passed problem keeps of it is as weak as the rule says."""
    problem, image = problem_of(error=0.3, sigma=0.01, claimed=0.01)
    found = misfit_of(problem, image)
    assert found.smooth[0] > 20 and "smooth part is" in str(found)
    easier = found.less_smooth(problem)
    after = misfit_of(easier, image)
    assert after.smooth[0] < found.smooth[0] / 3


def test_other_operators_have_none():
    matrix = Matrix(jnp.asarray(RNG.random((9, 12))), (3, 4), (9,))
    problem = InverseProblem([matrix], [RNG.random((1, 9))])
    assert misfit_of(problem, jnp.zeros(problem.image_shape)) is None
