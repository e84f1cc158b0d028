"""A plan's capture is within its tolerance, and says what it does."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.plan.scenes import camera, scene

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless.camera import psf_change
from thincam_jax.units import nm


@pytest.fixture(scope="module")
def deep(request):
    """Planes from 100 mm to 10 m, wavelengths, and their capture computed in full."""
    whole = scene(*getattr(request, "param", (16, 11)))
    return whole, tc.capture(camera(), whole)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("deep", "tolerance", "most_psfs"),
    [
        ((16, 11), 0.3, 1),
        ((6, 5), 1e-2, 20),
        ((16, 11), 1e-2, 20),
        ((32, 31), 0.1, 4),
        ((32, 31), 1e-2, 20),
        ((32, 31), 1e-3, 150),
    ],
    indirect=["deep"],
)
def test_error_is_within_the_tolerance_with_few_psfs(deep, tolerance, most_psfs):
    whole, full = deep
    plan = tc.plan_capture(camera(), whole, tolerance=tolerance, over_field=False)
    assert plan.meets_tolerance
    planned = tc.capture(camera(), whole, model=plan)
    true = relative_l2(planned, full)
    assert true <= plan.predicted_error <= tolerance
    assert len(plan.distances) * len(plan.wavelengths) <= most_psfs  # of 30, 176 or 992
    assert plan.cost.flops < (0.7 if len(whole.planes) == 6 else 0.25) * plan.full_cost.flops


@pytest.mark.thorough
def test_double_precision_where_single_cannot_serve():
    """At 1e-8 everything is computed, in float64 though the camera is in float32."""
    own, few = camera(np.float32), scene(2, 2, dtype=np.float32)
    plan = tc.plan_capture(own, few, tolerance=1e-7, over_field=False)
    assert (plan.method.model, plan.method.precision) == ("separable", "float64")
    planned = tc.capture(own, few, model=plan)
    assert planned.dtype == jnp.float32
    double = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (own, few))
    assert relative_l2(planned, tc.capture(*double)) < 1e-7
    assert not tc.plan_capture(
        own, few, tolerance=1e-9, over_field=False
    ).meets_tolerance  # the result is float32


@pytest.mark.thorough
@pytest.mark.parametrize(("width", "angle"), [(2.0, 20), (2.4, 12), (2.4, 25), (4.0, 20)])
def test_change_of_the_psf_over_the_field(width, angle):
    """Within a factor of two of that of the PSF at an angle."""
    tangent = math.tan(math.radians(angle))
    sensor = tc.Sensor((round(width / 0.02),) * 2, 0.02)
    on_axis = tc.LenslessCamera(tc.FresnelZoneAperture(25.0, width=width), sensor, 6.5)
    moved = tc.FresnelZoneAperture(25.0, width=width, centre=(0.0, 6.5 * tangent))
    exact, axis = (
        np.asarray(tc.psf(c, wavelength=500 * nm, at=(0.0, t), pixel_integration=True))
        for c, t in ((tc.LenslessCamera(moved, sensor, 6.5), tangent), (on_axis, 0.0))
    )
    change = np.linalg.norm(axis - exact) / np.linalg.norm(exact)
    finest = float(on_axis.mask.finest_frequency)
    found = psf_change(500 * nm, 6.5, finest, math.cos(math.radians(angle)))
    assert change / 2 < found < 2 * change


def test_what_cannot_be_planned():
    own = camera()

    def inside(distance):
        plan = tc.plan_capture(
            tc.LenslessCamera(own.mask, own.sensor, distance), scene(1, 1), tolerance=1.0
        )
        return jnp.asarray(plan.predicted_error)

    with pytest.raises(TypeError, match="plan_capture needs known numbers"):
        jax.jit(inside)(6.5)


def flat(distances, width_of, image=None):
    image = jnp.ones((24, 32)) if image is None else jnp.asarray(image)
    planes = [tc.ImagePlane(np.ones(image.shape), t, width_of * t) for t in distances]
    # Differences of scenes too, which no plane is built from: a negative radiance is refused.
    return [eqx.tree_at(lambda p: p.image, plane, image) for plane in planes]


def small(**mask):
    """64×72 pixels of 88 µm; the mask is the thesis' unless said otherwise."""
    mask = tc.FresnelZoneAperture(**({"beta": 25.0, "phase": 0.3, "width": 5.632} | mask))
    return tc.LenslessCamera(mask, tc.Sensor((64, 72), 0.088), 6.5)


def lit_edge():
    """One lit pixel, so far off the axis that its shadow misses the sensor."""
    image = np.zeros((33, 33))
    image[0, 16] = 1.0
    return image


WHITE = np.linspace(400 * nm, 1000 * nm, 5)
TEXTURE = np.random.default_rng(8).normal(size=(24, 32))
DARK_BUT_ONE = np.where(np.arange(7)[:, None, None] == 4, TEXTURE, 0.0)
# What asks more of a prediction than a scene of textures does.
ODD = {
    "coarse pixels behind a small mask": (
        tc.LenslessCamera(
            tc.FresnelZoneAperture(24.3, 0.3, width=0.101), tc.Sensor((64, 72), 0.03), 0.595
        ),
        tc.Scene(flat([100.0, 500.0, 5000.0], 1.6), tc.Spectrum(WHITE)),
    ),
    "one bright image in a dark batch": (
        small(),
        tc.Scene(flat([300.0], 0.3, DARK_BUT_ONE), tc.Spectrum(WHITE)),
    ),
    "planes that cancel": (
        small(),
        tc.Scene(
            [*flat([1000.0], 0.2, TEXTURE), *flat([1010.0], 0.2, -TEXTURE)], tc.Spectrum(WHITE)
        ),
    ),
    "light beside the sensor": (
        small(),
        tc.Scene(flat([250.0], 2.0, lit_edge()), tc.Spectrum(WHITE[:3])),
    ),
    "a display": (
        small(pixel_pitch=0.176),
        tc.Scene(flat([100.0, 300.0], 0.3, TEXTURE), tc.Spectrum(WHITE[:3])),
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("tolerance", [0.1, 1e-2, 1e-3])
def test_odd_scenes_stay_within_their_prediction(name, tolerance):
    own, odd = ODD[name]
    plan = tc.plan_capture(own, odd, tolerance=tolerance, over_field=False)
    true = relative_l2(tc.capture(own, odd, model=plan), tc.capture(own, odd))
    assert true <= plan.predicted_error <= tolerance


@pytest.mark.thorough
def test_a_plan_notices_other_light_and_larger_planes():
    few = scene(2, 3)
    plan = tc.plan_capture(camera(), few, tolerance=0.1)
    brighter = tc.Scene(few.planes, tc.Spectrum(few.spectrum.wavelengths, [0.2, 0.2, 0.2]))
    with pytest.raises(ValueError, match=r"for 3 given weights.*make a plan"):
        tc.capture(camera(), brighter, model=plan)
    wider = [tc.ImagePlane(p.image, p.distance, 2 * p.width) for p in few.planes]
    with pytest.raises(ValueError, match=r"cover \(\d+, \d+\) samples.*make a plan"):
        tc.capture(camera(), tc.Scene(wider, few.spectrum), model=plan)
    with pytest.raises(TypeError, match=r"scene is ImagePlane\(.*; give Scene\(planes, …\)"):
        tc.plan_capture(camera(), few.planes[0], tolerance=0.1)


def test_a_batch_is_planned_as_one():
    colours = scene(3, 2, batch=(3,))
    plan = tc.plan_capture(camera(), colours, tolerance=1e-2, over_field=False)
    planned = tc.capture(camera(), colours, model=plan)
    assert relative_l2(planned, tc.capture(camera(), colours)) <= plan.predicted_error
