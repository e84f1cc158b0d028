"""From scene to capture: where points go, what adds up, noise, odd sensors, gradients, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2, value_and_slope
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.lensless.forward import imaging_operator
from thincam_jax.units import nm, um

# 1.6 mm × 1.92 mm of sensor; β·(width/2)² = 36 rad, zones at the edge of 9.5 cycles/mm (Nyquist 25)
SENSOR = tc.Sensor((80, 96), 20 * um)
DISTANCE, OBJECT_DISTANCE = 3.0, 100.0
OBJECT_PITCH = 20 * um * OBJECT_DISTANCE / DISTANCE  # a scene pixel that projects on one of ours


def camera(*, beta=25.0, phase=0.4, width=2.4, centre=(0.0, 0.0), sensor=SENSOR):
    mask = tc.FresnelZoneAperture(beta, phase, width=width, centre=centre)
    return tc.LenslessCamera(mask=mask, sensor=sensor, distance=DISTANCE)


def plane(image, distance=OBJECT_DISTANCE, pixel=OBJECT_PITCH):
    return tc.ImagePlane(image, distance, pixel * np.shape(image)[-1])


def photograph(shape=(30, 40), seed=0):
    return np.random.default_rng(seed).uniform(0.1, 1.0, shape)


def shifted_psf(own, shadow, **how):
    """The PSF about another place, (y, x) in mm: that of a camera whose mask is moved instead."""
    centre = np.asarray(shadow) / (1 + DISTANCE / OBJECT_DISTANCE)
    moved = tc.LenslessCamera(
        tc.FresnelZoneAperture(25.0, 0.4, width=2.4, centre=centre), own.sensor, DISTANCE
    )
    return tc.psf(moved, wavelength=500 * nm, object_distance=OBJECT_DISTANCE, **how)


@pytest.mark.parametrize(
    ("sensor", "shape", "how"),
    quick(
        [
            ((80, 96), (30, 40), {"model": "separable", "pixel_integration": True}),
            ((81, 96), (23, 16), {"model": "closed_form", "pixel_integration": False}),
        ],
        1,
    ),
)
def test_a_point_at_m_gives_the_psf_at_minus_m_d_over_t(sensor, shape, how):
    own = camera(sensor=tc.Sensor(sensor, 20 * um))
    row, column = 3, shape[1] - 2
    image = np.zeros(shape)
    image[row, column] = 2.0
    value = tc.capture(own, tc.Scene(plane(image), 500 * nm), **how)
    point = np.array([row - (shape[0] - 1) / 2, column - (shape[1] - 1) / 2]) * OBJECT_PITCH
    shadow = -DISTANCE / OBJECT_DISTANCE * point  # above and to the right: below and to the left
    assert shadow[0] > 0.1 and shadow[1] < -0.1
    h = shifted_psf(own, shadow, **how)
    assert relative_l2(value, 2.0 * (20 * um) ** 2 * h) < 1e-10


@pytest.mark.thorough
def test_a_source_between_the_pixels_moves_the_centroid():
    """The shadow of a small mask, of a source 2.5 pixels wide: its centroid is at −(d/t)·m.

    The source's edges are averaged over a pixel: that moves the centroid by f(1 − f)/2 of a pixel
    in 2.5 at most, 0.05.
    """
    sensor = tc.Sensor((60, 75), 20 * um)
    small = camera(beta=100.0, phase=0.0, width=0.5, sensor=sensor)
    image = np.zeros((12, 16))
    image[3, 12] = 1.0
    scene = tc.Scene(plane(image, pixel=2.5 * OBJECT_PITCH), 500 * nm)
    value = np.asarray(tc.capture(small, scene, model="geometric"))
    y, x = np.asarray(sensor.grid.y), np.asarray(sensor.grid.x)
    centroid = np.array([value.sum(1) @ y, value.sum(0) @ x]) / value.sum()
    shadow = -np.array([3 - 5.5, 12 - 7.5]) * 2.5 * 20 * um
    np.testing.assert_allclose(centroid, shadow, atol=0.06 * 20 * um)


@pytest.mark.thorough
def test_planes_and_wavelengths_add_with_their_weights():
    near, far = plane(photograph(), 80.0), plane(photograph((20, 27), 1), 150.0)
    how = {"model": "closed_form"}
    colours, weights = [450 * nm, 2000 * nm], [0.3, 1.2]
    whole = tc.capture(camera(), tc.Scene([near, far], tc.Spectrum(colours, weights)), **how)
    parts = [
        weight * tc.capture(camera(), tc.Scene(p, colour), **how)
        for p in (near, far)
        for colour, weight in zip(colours, weights, strict=True)
    ]
    assert relative_l2(whole, sum(parts)) < 1e-12
    # each part is different, so that none can stand in for another
    assert relative_l2(parts[0] / 0.3, parts[1] / 1.2) > 0.005
    assert relative_l2(parts[0], parts[2]) > 0.1


def test_energy():
    """The light on a large sensor: radiance × area of the scene's shadow × ∫|t(r/M)|² dA."""
    beta, width, phase, magnification = 25.0, 1.4, 0.4, 1 + DISTANCE / OBJECT_DISTANCE
    sensor = tc.Sensor((120, 137), 20 * um)
    own = camera(beta=beta, width=width, phase=phase, sensor=sensor)
    image = photograph((21, 28))
    value = tc.capture(own, tc.Scene(plane(image), 500 * nm), model="geometric")
    nodes, weights = np.polynomial.legendre.leggauss(80)
    r2 = (width / 2) ** 2 * (nodes[:, None] ** 2 + nodes**2)
    transmitted = (0.5 + 0.5 * np.cos(beta * r2 + phase)) ** 2
    integral = weights @ transmitted @ weights * (width / 2 * magnification) ** 2
    radiance = image.sum() * (OBJECT_PITCH * DISTANCE / OBJECT_DISTANCE) ** 2
    total = value.sum() * (20 * um) ** 2
    np.testing.assert_allclose(total, radiance * integral, rtol=1e-10)


@pytest.mark.parametrize("shape", [pytest.param((1, 1), marks=pytest.mark.thorough), (1, 9)])
def test_single_pixels_and_lines(shape):
    """Every pixel is the sum of the PSF times the turned scene, written out."""
    field = (5 + (shape[0] + 1) % 2, 7 + (shape[1] + 1) % 2)
    image = photograph(field)
    own = camera(sensor=tc.Sensor(shape, 20 * um))
    value = tc.capture(own, tc.Scene(plane(image), 500 * nm))
    wide = own.on_grid(kernel_grid(own.sensor.grid, field))
    h = tc.psf(wide, wavelength=500 * nm, object_distance=OBJECT_DISTANCE, pixel_integration=True)
    windows = np.lib.stride_tricks.sliding_window_view(np.asarray(h), field)
    # the turn of the pinhole and that of the convolution cancel
    expected = (20 * um) ** 2 * np.sum(windows * image, axis=(2, 3))
    np.testing.assert_allclose(value, expected, rtol=1e-10)


def test_gradients_of_camera_and_scene():
    """In β, the mask's width and the radiance, of the shadow averaged over the pixels.

    The fastest phase is 2β(width/2)² = 72 rad, 2.9 rad per rad/mm²; in the width the averages are
    smooth until an edge passes the border of a pixel, 0.01 mm away.
    """
    small = tc.Sensor((24, 29), 40 * um)
    image, weights = photograph((10, 13)), photograph((24, 29), 2) - 0.5
    fixed = camera(width=1.18, sensor=small)
    view = tc.Scene(tc.ImagePlane(image, OBJECT_DISTANCE, 17.0), 5e-4)

    # sizes are those of the objects from outside
    def loss(numbers):
        own = eqx.tree_at(
            lambda c: (c.mask.beta, c.mask.width), fixed, (numbers["beta"], numbers["width"])
        )
        scene = eqx.tree_at(lambda s: s.planes[0].image, view, image * numbers["gain"] ** 2)
        return jnp.sum(weights * tc.capture(own, scene, model="geometric"))

    at = {"beta": jnp.asarray(25.0), "width": jnp.asarray(1.18), "gain": jnp.asarray(1.1)}
    value, slope = value_and_slope(loss)
    slopes = slope(at)
    for name, step in {"beta": 1e-3, "width": 1e-4, "gain": 1e-2}.items():
        direction = {other: jnp.asarray(float(other == name)) for other in at}
        expected = finite_difference(value, at, direction, step)
        np.testing.assert_allclose(slopes[name], expected, rtol=1e-7, err_msg=name)


def test_sizes_must_be_known_numbers():
    image = photograph((5, 6))

    def total(width):
        scene = tc.Scene(tc.ImagePlane(image, OBJECT_DISTANCE, width), 500 * nm)
        return tc.capture(camera(), scene).sum()

    with pytest.raises(TypeError, match="known numbers.*imaging_operator"):
        jax.jit(total)(4.0)


def test_the_operator_inside_jit_is_differentiable_in_the_distance():
    """What `capture` refuses: the size of the field is given, so the distance may be traced."""
    field, weights = jnp.asarray(photograph((9, 12))), photograph((24, 29), 2) - 0.5
    sensor = tc.Sensor((24, 29), 40 * um)
    mask = tc.FresnelZoneAperture(25.0, 0.4, width=2.4)

    def weighted(distance):
        own = tc.LenslessCamera(mask=mask, sensor=sensor, distance=distance)
        convolution = imaging_operator(
            own,
            500 * nm,
            OBJECT_DISTANCE,
            field_shape=(9, 12),
            model="closed_form",
            pixel_integration=False,
        )
        return jnp.sum(weights * convolution(field))

    # β/(1 ± ε) turns by βr²·ε/d: 25·5 rad (the corner of the kernel's grid)·0.012/3, slowly
    at, one = jnp.asarray(DISTANCE), jnp.asarray(1.0)
    loss, slope = value_and_slope(weighted)
    np.testing.assert_allclose(slope(at), finite_difference(loss, at, one, 1e-2), rtol=1e-7)


def test_sizes_beyond_the_memory_are_refused_with_an_estimate(monkeypatch):
    scene = tc.Scene(plane(photograph()), 500 * nm)
    monkeypatch.setattr("thincam_jax._core.memory.available_bytes", lambda: 300_000)
    with pytest.raises(
        MemoryError, match=r"80×96 pixels.*30×40 needs about \d+\.\d KiB, 293.0 KiB are free"
    ):
        tc.capture(camera(), scene)
    # a batch of 100 needs more than a single image
    monkeypatch.setattr("thincam_jax._core.memory.available_bytes", lambda: 3_000_000)
    tc.capture(camera(), scene)
    with pytest.raises(MemoryError, match="fewer images"):
        tc.capture(camera(), tc.Scene(plane(photograph((100, 30, 40))), 500 * nm))
