"""The recipes of CONTRIBUTING.md, followed; that of a device in tests/commands/capture."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

import thincam_jax as tc
from helpers import finite_difference, recipe, relative_l2
from thincam_jax.units import nm, um

LIGHT = {"wavelength": 550 * nm, "pixel_integration": True}


def followed(name):
    """What the code of a recipe defines."""
    defined = {"__name__": name}
    exec(recipe(name), defined)
    return defined


def double_slit(width):
    mask = followed("a mask")["DoubleSlit"](width=width, spacing=60 * um, height=90 * um)
    return tc.LenslessCamera(mask, tc.Sensor((24, 40), 6 * um), 2.0)


def test_a_mask_has_its_exact_psf_and_gradients():
    camera = double_slit(24 * um)
    exact = tc.psf(camera, **LIGHT)
    methods = [tc.PsfMethod("angular_spectrum", oversampling=n) for n in (3, 9)]
    errors = [relative_l2(tc.psf(camera, model=method, **LIGHT), exact) for method in methods]
    assert errors[1] < 0.01 and errors[1] < errors[0] / 2

    def brightness(width):
        return tc.psf(double_slit(width), **LIGHT)[12, 20]

    slope, one = jax.grad(brightness)(0.024), jnp.ones(())
    assert np.isclose(
        slope, finite_difference(brightness, jnp.asarray(0.024), one, 1e-5), rtol=1e-5
    )


def test_a_solver_finds_what_a_matrix_gives(key):
    """One capture that the sensor crops, of a field of 9×13 pixels; the matrix is SciPy's."""
    psf = np.array([[0.0, 0.2, 0.0], [0.1, 0.4, 0.1], [0.0, 0.1, 0.1]])
    capture = np.asarray(jax.random.uniform(key, (5, 7)))
    psfs = tc.Psfs(np.pad(psf, ((1, 1), (2, 2)))[None])
    recording = tc.Recording(capture[None, None], psfs, noise_variance=1.0)
    found = tc.reconstruct(recording, followed("a solver")["LeastSquares"](strength=0.01))
    pixels = np.eye(9 * 13).reshape(-1, 9, 13)
    seen = [scipy.signal.convolve2d(pixel, psf, "same")[2:-2, 3:-3].ravel() for pixel in pixels]
    matrix = np.stack(seen, axis=1)
    normal = matrix.T @ matrix + 0.01 * np.eye(9 * 13)
    image = np.linalg.solve(normal, matrix.T @ capture.ravel()).reshape(9, 13)
    np.testing.assert_allclose(found.image[0], image[2:-2, 3:-3], rtol=1e-6)
    assert (found.method, found.status) == ("least_squares", "converged")
