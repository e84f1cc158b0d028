"""What a rig's frames are compared with: the noise of its camera, the matrix of its monitor."""

import jax.numpy as jnp
import numpy as np
import pytest
from studies import tiny_screen

from thincam_jax import waveguide as wg
from thincam_jax.studies.rig import CountingCamera, monitor_system


def test_variance_of_counts():
    """Shot noise, read noise and rounding, in counts²."""
    camera = CountingCamera(counts=1.0, electron=0.25, read_noise=2.0)
    np.testing.assert_allclose(camera.variance(np.array([0.0, 100.0])), [1 / 3, 25 + 1 / 3])


def test_a_white_monitor_is_1_where_it_is_brightest():
    study = tiny_screen.study()
    system = monitor_system(study.camera, study.plane, 2)
    white = system(jnp.ones(study.plane.shape, system.values.dtype))
    assert float(jnp.max(white)) == pytest.approx(1)
    elsewhere = wg.ObjectPlane(study.plane.shape, 550.0, 120.0, (0.0, 9000.0))
    with pytest.raises(ValueError, match="no light from the monitor reaches the sensor"):
        monitor_system(study.camera, elsewhere, 2)
