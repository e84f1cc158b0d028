"""The lensless camera: its distance, the way of the light through it, its gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax._core.precision import cast
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


def test_a_camera_is_a_tree_of_its_numbers():
    """β, φ, width, distance and pitch are leaves, so that gradients reach them through jit."""

    @jax.jit
    def shadow_width(camera):
        return camera.mask.width * camera.path(500 * nm, 250.0).magnification

    slopes = jax.grad(shadow_width)(camera())
    assert float(slopes.mask.width) == pytest.approx(1.026)
    assert float(slopes.distance) == pytest.approx(5.632 / 250)
    assert float(slopes.mask.beta) == 0.0 and float(slopes.sensor.pitch) == 0.0


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


def test_a_point_takes_the_precision_of_its_camera():
    """Along an axis, too; so does one that is traced."""
    single, at = cast(CAMERA, "float32"), np.array([0.0, 7.0])
    path = single.path(500 * nm, 250.0, at)
    assert path.at.dtype == jnp.float32 and not path.skew
    traced = jax.eval_shape(lambda at: single.path(500 * nm, 250.0, at).at, jnp.asarray(at))
    assert traced.dtype == jnp.float32


def test_swapped_arguments_are_refused():
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    sensor = tc.Sensor((3, 4), 0.1)
    with pytest.raises(TypeError, match="mask is a Sensor; give a mask, such as"):
        tc.LenslessCamera(sensor, mask, 5.0)
    with pytest.raises(TypeError, match="sensor is a NoneType; give a thincam_jax.Sensor"):
        tc.LenslessCamera(mask, None, 5.0)
