"""Simulated recordings, the names of solvers, and changes of one number."""

import numpy as np
import PIL.Image
import pytest
import skimage.data
from raw_files import SRGB, dng

import thincam_jax as tc
from thincam_jax.imaging.targets import resize
from thincam_jax.units import deg, nm, um

SENSOR = tc.Sensor((40, 52), 60 * um)
CELLS = np.random.default_rng(0).random((20, 20)) < 0.4
CAMERA = tc.LenslessCamera(tc.SampledMask(CELLS, 60 * um), SENSOR, distance=3.0)
ZONES = [
    tc.LenslessCamera(tc.FresnelZoneAperture(12.0, phase, width=1.6), SENSOR, distance)
    for phase, distance in ((0.0, 4.0), (270 * deg, 4.0), (0.0, 3.0))
]
PICTURE = skimage.data.camera()[::16, ::16] / 255.0


def scene(width=120.0, distance=250.0, **light):
    return tc.Scene(tc.ImagePlane(PICTURE, distance, width), **light or {"wavelength": 550 * nm})


def test_one_camera_is_captured_as_by_capture():
    noise = tc.GaussianNoise(30.0)
    recording = tc.record(CAMERA, scene(), noise=30.0, key=3)
    expected = tc.capture(CAMERA, scene(), noise=noise, key=3)
    np.testing.assert_array_equal(recording.captures[0], expected)
    np.testing.assert_allclose(recording.noise_variance, noise.variance(expected))
    optics = recording.imaging_model
    assert float(optics.object_distance) == 250.0 and float(optics.wavelength) == 550 * nm
    # Pixels of 60 µm · 250/3 on the object, of the parity of the sensor's.
    assert optics.field_shape == (24, 24)


@pytest.mark.thorough
def test_planes_and_spectra_are_those_of_the_scene():
    """A polychromatic recording explains its capture, which the mean wavelength does not."""
    near, far = (tc.ImagePlane(PICTURE, d, 0.4 * d) for d in (100.0, 300.0))
    optics = tc.record(CAMERA, tc.Scene([far, near], 550 * nm)).imaging_model
    np.testing.assert_array_equal(optics.object_distance, [100.0, 300.0])
    light = tc.Spectrum([420 * nm, 680 * nm], [0.5, 0.5])
    fine = tc.LenslessCamera(tc.FresnelZoneAperture(40.0, width=1.6), SENSOR, 6.0)
    recording = tc.record(fine, scene(width=60.0, spectrum=light))
    optics = recording.imaging_model
    alone = recording.replace(imaging_model=optics.replace(wavelength=550 * nm))
    errors = []
    for one in (recording, alone):
        shape = one.problem().image_shape[-2:]
        image = scene(60.0).planes[0].sample(tc.Grid(shape, optics.pitch), magnification=1.0)
        seen = one.problem().operators[0](one.oriented(image)[None, None])[0]
        errors.append(np.linalg.norm(seen - one.captures[0]) / np.linalg.norm(seen))
    assert errors[0] < 1e-6 < 3e-4 < errors[1]
    wiener = tc.reconstruct(recording, "wiener").image
    assert not np.allclose(wiener, tc.reconstruct(alone, "wiener").image, rtol=1e-3)


def test_changes_of_one_number():
    moved = CAMERA.replace(distance=4.0)
    assert float(moved.distance) == 4.0 and moved.mask is CAMERA.mask
    assert float(ZONES[0].mask.replace(beta=20.0).beta) == 20.0
    assert tc.AdmmTV(3.0).replace(iterations=7).iterations == 7
    recording = tc.record(CAMERA, scene())
    assert recording.replace(background=0.0).background is not None
    with pytest.raises(TypeError, match="LenslessCamera has no distanse; give distance"):
        CAMERA.replace(distanse=3.0)


def test_solvers_by_name():
    recording = tc.record(CAMERA, scene())
    image = tc.reconstruct(recording, "wiener").image
    np.testing.assert_array_equal(image, tc.reconstruct(recording, tc.Wiener()).image)
    for given, meant in (("weiner", "wiener"), ("AdmmTV", "admm_tv"), ("admm-tv", "admm_tv")):
        said = f"'{given}' is unknown; choose one of 'wiener', .*; did you mean '{meant}'\\?$"
        with pytest.raises(ValueError, match=said):
            tc.reconstruct(recording, given)


def test_a_mosaic_is_recorded_in_one_frame():
    """Its parts' PSFs hold the parallax: without their places near objects come out doubled."""
    phases = (0.0, 90 * deg), (180 * deg, 270 * deg)
    masks = [[tc.FresnelZoneAperture(40.0, p, width=1.4) for p in row] for row in phases]
    one = tc.Mosaic(masks, tc.Sensor((148, 170), 20 * um), 4.0, wall=0.05)
    seen = scene(width=15.0, distance=60.0)
    recording = tc.record(one, seen, noise=40.0, key=1)
    frame = tc.capture(one, seen, noise=tc.GaussianNoise(40.0), key=1)
    for part, capture in zip(one.split(frame), recording.captures, strict=True):
        np.testing.assert_array_equal(part, capture)
    variance = float(tc.GaussianNoise(40.0).variance(frame))
    np.testing.assert_allclose(recording.noise_variance, [variance] * 4, rtol=1e-5)
    optics = recording.imaging_model
    alone = [camera.replace(place=None) for camera in optics.cameras]
    unregistered = recording.replace(imaging_model=optics.replace(cameras=alone))
    for solver in (tc.FringeScanning(), tc.Wiener()):
        found = []
        for given in (recording, unregistered):
            image = tc.reconstruct(given, solver).image
            grid = tc.Grid(image.shape, optics.pitch)
            truth = seen.planes[0].sample(grid, magnification=1.0)
            found.append(tc.imaging.metrics.psnr(np.asarray(image), np.asarray(truth)))
        assert found[0] > found[1] + 1.0


FOUR = [ZONES[0].replace(mask=ZONES[0].mask.replace(phase=n * 90 * deg)) for n in range(4)]
MURA = tc.LenslessCamera(tc.ModifiedUniformlyRedundantArray(11, 120 * um), SENSOR, distance=3.0)
COLOURS = np.stack([PICTURE, PICTURE[::-1], PICTURE[:, ::-1]])
MOVED = tc.ImagePlane(PICTURE, 250.0, 120.0, moves=(0.0, 4.0))
WHITE = tc.Spectrum([480 * nm, 540 * nm, 600 * nm])
LEFT = np.where(np.arange(32) < 16, PICTURE, 0.0)
PLANES = [tc.ImagePlane(PICTURE - LEFT, 300.0, 120.0), tc.ImagePlane(LEFT, 40.0, 16.0)]
KINDS = {
    "colours": (ZONES[0], tc.Scene(tc.ImagePlane(COLOURS, 250.0, 120.0), 550 * nm)),
    "two planes": (ZONES, tc.Scene(PLANES, 550 * nm)),
    "four phases": (FOUR, scene()),
    "MURA": (MURA, scene()),
    "own mask": (CAMERA, scene()),
    "moving": (CAMERA, tc.Scene(MOVED, 550 * nm)),
    "polychromatic": (ZONES[0], scene(spectrum=WHITE)),
    "two distances": (ZONES[::2], scene()),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_three_lines_of_each_kind_give_an_image_of_the_scene(kind):
    camera, seen = KINDS[kind]
    assert_images(camera, seen)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["a.dng", "a.jpg"])
def test_three_lines_of_a_raw_file_and_of_12_megapixels(tmp_path, name):
    path, size = tmp_path / name, (3000, 4000) if name == "a.jpg" else (300, 400)
    light = resize(skimage.data.astronaut() / 255.0, size)
    if name == "a.jpg":
        PIL.Image.fromarray(np.round(255 * light).astype(np.uint8)).save(path)
    else:
        path.write_bytes(dng("GBRG", 6, light=np.moveaxis(3800 * light, -1, 0), matrix=SRGB))
    assert_images(ZONES[0], tc.Scene.photograph(path, distance=250.0, width=120.0))


def assert_images(camera, seen):
    result = tc.reconstruct(tc.record(camera, seen, noise=40.0))
    assert result._repr_png_().startswith(b"\x89PNG")
    image, pitches = np.asarray(result.image), np.ravel(result.pitch)
    planes = sorted(seen.planes, key=lambda plane: float(plane.distance))
    for number, (plane, pitch) in enumerate(zip(planes, pitches, strict=True)):
        truth = plane.sample(tc.Grid(image.shape[-2:], pitch), magnification=1.0)
        one = image[number] if len(planes) > 1 else image
        assert np.corrcoef(np.ravel(one), np.ravel(truth))[0, 1] > 0.75
