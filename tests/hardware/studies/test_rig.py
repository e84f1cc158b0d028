"""What a rig's frames are compared with: the noise of its camera, the matrix of its monitor."""

import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.studies import tiny_screen

from thincam_jax import Ridge
from thincam_jax import waveguide as wg
from thincam_jax.hardware.studies.rig import CountingCamera, reconstruct_pictures
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.waveguide.system import monitor_system


def test_variance_of_counts():
    """Shot noise, read noise and rounding, in counts²."""
    camera = CountingCamera(counts=1.0, electron=0.25, read_noise=2.0)
    np.testing.assert_allclose(camera.variance(np.array([0.0, 100.0])), [1 / 3, 25 + 1 / 3])


def test_a_white_monitor_is_1_where_it_is_brightest():
    study = tiny_screen.study()
    system = monitor_system(study.camera, study.plane, 2)
    white = system(jnp.ones(study.plane.shape, system.values.dtype))
    assert float(jnp.max(white)) == pytest.approx(1)
    elsewhere = wg.ObjectPlane(study.plane.shape, 550.0, 120.0, (9000.0, 0.0))
    with pytest.raises(ValueError, match="no light from the monitor reaches the sensor"):
        monitor_system(study.camera, elsewhere, 2)


def test_pixels_of_a_matrix_that_are_not_known_are_left_out():
    random = np.random.default_rng(0)
    matrix = random.random((20 * 30, 8 * 9)).astype(np.float32)
    picture = random.random((8, 9))
    frame = (matrix @ picture.ravel()).reshape(20, 30) + 1e-3 * random.normal(size=(20, 30))
    variance = np.full((20, 30), 1e-6)
    variance[3, :5], frame[3, :5] = np.inf, 1e4
    solvers, known = {"ridge": Ridge()}, (matrix, ReducedMatrix.of(matrix, (8, 9)))
    found = reconstruct_pictures({"one": picture}, frame[None], known, solvers, variance)
    assert np.std(found.methods["ridge"].images[0] - picture) < 1e-3
    with pytest.raises(ValueError, match="the matrix 600 rows"):
        reconstruct_pictures({"one": picture}, frame[None, 1:], known, solvers, variance[1:])
