"""Notebooks of some 15 lines, by names guessed from docs/start.md and docs/api/index.md."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.units import deg, nm, um

pytestmark = pytest.mark.thorough


@pytest.fixture
def precision_of_a_user():
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        yield


def test_an_fza_capture_and_its_image(precision_of_a_user):
    mask = tc.FresnelZoneAperture(beta=17.0, width=4.0)
    sensor = tc.Sensor(shape=(64, 80), pitch=64 * um)
    camera = tc.LenslessCamera(mask=mask, sensor=sensor, distance=6.5)
    photo = tc.imaging.targets.sample_image("camera")
    plane = tc.ImagePlane(photo, distance=250.0, width=120.0)
    scene = tc.Scene(plane, wavelength=530 * nm)
    noise = tc.GaussianNoise(snr_db=40.0)
    capture = tc.capture(camera, scene, noise=noise, key=0)
    optics = tc.Cameras([camera], wavelength=530 * nm, object_distance=250.0, field_shape=(48, 48))
    recording = tc.Recording([capture], optics, noise_variance=noise.variance(capture))
    result = tc.reconstruct(recording, tc.AdmmTV(tau=1.0))
    figure = tc.plot.compare({"photo": photo, "capture": capture, "image": result})
    assert len(figure.axes) == 3
    truth = plane.sample(tc.Grid(result.image.shape, result.pitch), magnification=1.0)
    aligned = tc.imaging.metrics.align(result.image, truth)
    assert tc.imaging.metrics.ssim(aligned, truth) > 0.2


def test_the_gradient_of_an_mtf_in_beta():
    sensor = tc.Sensor(shape=(64, 80), pitch=64 * um)

    def contrast(beta):
        mask = tc.FresnelZoneAperture(beta, width=4.0)
        camera = tc.LenslessCamera(mask, sensor, distance=6.5)
        return tc.mtf(camera, wavelength=530 * nm, object_distance=250.0)[20]

    value, slope = jax.value_and_grad(contrast)(17.0)
    assert 0 < value < 1
    step = 1e-3
    expected = (contrast(17.0 + step) - contrast(17.0 - step)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-4)


def test_a_screen_calibrated_by_hadamard_patterns_in_memory(precision_of_a_user):
    wg, calibration = tc.waveguide, tc.measured.calibration
    hologram = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    screen = wg.Screen(hologram, glass_thickness=5.0, glass_index=1.5)
    sensor = tc.Sensor(shape=(22, 30), pitch=70 * um)
    camera = wg.SeeThroughCamera(screen, sensor, focal_distance=6.0, lens_distance=10.0)
    plane = wg.ObjectPlane(shape=(8, 16), distance=550.0, width=150.0, centre=(27.0, 0.0))
    system = wg.system_operator(camera, plane, orders=4)
    series = calibration.HadamardSeries(plane.shape)
    captures = calibration.simulate_captures(series, system, key=0, noise_std=1e-3)
    matrix = calibration.recover_matrix(captures)
    photo = tc.imaging.targets.resize(tc.imaging.targets.sample_image("camera"), plane.shape)
    recording = tc.Recording(system(jnp.asarray(photo)), matrix, noise_variance=1e-6)
    result = tc.reconstruct(recording, tc.Ridge(1e-3))
    assert tc.imaging.metrics.psnr(result.image, photo) > 20
