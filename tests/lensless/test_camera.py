"""The lensless camera, its gradients, and its exposures."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference
from thincam_jax.units import nm, um

MASK = tc.FresnelZoneAperture(25.0, width=5.632)


def camera(distance=6.5):
    return tc.LenslessCamera(mask=MASK, sensor=tc.Sensor((80, 96), 5.5 * um), distance=distance)


CAMERA = camera()  # of known numbers, not of those of a trace


def test_path_of_the_thesis_camera():
    """M = (t+d)/t magnifies the shadow; ε = βλd/(πM) measures the diffraction."""
    path = camera().path(500 * nm, 250.0)
    assert float(path.magnification) == pytest.approx(1.026)
    assert float(path.epsilon(jnp.asarray(25.0))) == pytest.approx(0.025862 / 1.026, rel=1e-4)
    assert float(path.fresnel_curvature) == pytest.approx(np.pi * 1.026 / (5e-4 * 6.5))
    assert float(camera().path(500 * nm, jnp.inf).magnification) == 1.0


def test_a_point_known_to_lie_on_an_axis_of_the_mask_is_not_skew_inside_jit():
    """As for a slope in the other coordinate; skew PSFs take many times longer."""
    skew = []

    @jax.jit
    def trace(x, centre):
        moved = tc.FresnelZoneAperture(25.0, width=5.632, centre=(0.0, 0.1))
        traced = tc.FresnelZoneAperture(25.0, width=5.632, centre=centre)
        for one, at in [(None, (0.0, x)), (None, (x, 0)), (None, (x, x)), (moved, (x, 0.0))]:
            chosen = replace(CAMERA, mask=one or MASK)
            skew.append(chosen.path(500 * nm, 250.0, at).skew)
        skew.append(replace(CAMERA, mask=traced).path(500 * nm, 250.0, (0.0, x)).skew)

    trace(3.0, jnp.zeros(2))
    assert skew == [False, False, True, True, True]


LIGHT = {"wavelength": 5e-4, "width": 2.0}
SENSOR = tc.Sensor((6, 8), 0.04, electrons=1e5)


def test_digits_survive_single_precision():
    """Numbers of JAX in single precision come back as they were typed."""
    with jax.enable_x64(False):
        exposures = tc.Exposures(jnp.asarray([0.1, 25.3]), 6.4, **LIGHT)
        assert exposures.beta.dtype == jnp.float32
        assert [e.beta for e in exposures] == [0.1, 25.3]


def test_equal_exposures_are_further_takes():
    exposures = tc.Exposures([25.0, 21.0, 25.0], 6.5, **LIGHT)
    assert exposures.take == (1, 1, 2)
    assert len(set(exposures)) == 3
    # Methods share what they both take.
    shared = {*tc.Exposures(25.0, 6.5, **LIGHT).fringe_scanned(), *exposures.phase_pairs()}
    assert len(shared) == 4 + 6 - 2


def test_objects_move_on_from_one_to_the_next():
    """4 mm an exposure; half way through the time it is on the axis."""
    exposures = tc.Exposures([25.0, 21.0], 6.5, relative_time=[1, 0.5], **LIGHT).of_moving(4.0)
    np.testing.assert_allclose(exposures.moves, [(-3, 1), (1, 3)])
    assert exposures[1].moves == (1.0, 3.0)


def test_cameras_differ_in_what_exposures_do():
    mask = tc.FresnelZoneAperture(
        1.0, width=2.0, height=1.2, profile="binary", pixel_pitch=0.1, fill_factor=0.8, harmonics=3
    )
    exposures = tc.Exposures(
        25.0, [5.0, 6.5], wavelength=5e-4, width=[2.0, 1.0], relative_time=[1, 0.3]
    )
    first, second = exposures.cameras(SENSOR, mask)
    expected = tc.FresnelZoneAperture(
        25.0, width=1.0, height=1.2, profile="binary", pixel_pitch=0.1, fill_factor=0.8, harmonics=3
    )
    assert str(second.mask) == str(expected) and second.mask.pixels == (12, 10)
    assert float(second.distance) == 6.5
    assert float(second.sensor.electrons) == pytest.approx(3e4)
    assert first.sensor is SENSOR
    with pytest.raises(ValueError, match="not a whole number of cells of pixel_pitch = 0.1 mm"):
        tc.Exposures(25.0, 5.0, wavelength=5e-4, width=1.13).cameras(SENSOR, mask)


def test_gradients_pass_to_the_cameras():
    def light(beta):
        exposures = tc.Exposures(beta, [5.0, 6.5], **LIGHT).phase_pairs()
        return sum(jnp.sum(c.mask.beta**2 * c.distance) for c in exposures.cameras(SENSOR))

    beta = jnp.asarray(25.0)
    slope = jax.jit(jax.grad(light))(beta)
    np.testing.assert_allclose(slope, finite_difference(light, beta, jnp.ones(()), 1e-2), rtol=1e-6)
