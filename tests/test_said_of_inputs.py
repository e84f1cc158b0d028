"""Inputs that cost decibels in silence or ended in words that named no cause: each is said now."""

import warnings

import numpy as np
import PIL.Image
import pytest
import tifffile
from measured.test_examination import cells, counts, diffuser, quality, scene, seen, spots, zones
from PIL.PngImagePlugin import PngInfo
from typer.testing import CliRunner

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.commands import cli
from thincam_jax.imaging.defects import stuck, wrapped
from thincam_jax.lensless.resolve import SamplingWarning
from thincam_jax.measured import Raw, examine, prepare, read_image
from thincam_jax.measured.raw import MeasurementError
from thincam_jax.measured.read import CaptureFileError, NonlinearWarning
from thincam_jax.units import nm, um

SHAPE, DARK = (48, 64), 64
TRUE = scene(SHAPE)


def light_of(camera, noise=3.0):
    """PSF and capture, 12 bit above a black level."""
    light = camera(SHAPE)
    return counts(light, 1, noise=noise), counts(seen(TRUE, light), 2, noise=noise)


@pytest.mark.parametrize(
    ("tag", "value", "power"),
    [(b"gAMA", 45455, 1 / 2.2), (b"gAMA", 100000, 1.0), (b"sRGB", None, 1 / 2.2)],
)
def test_png_that_says_a_gamma(tmp_path, tag, value, power):
    """The advice makes counts that are linear; a gamma of 1 is nothing to say."""
    path, info = tmp_path / "capture.png", PngInfo()
    info.add(tag, b"\0" if value is None else value.to_bytes(4, "big"))
    light = np.linspace(0, 1, 48 * 64).reshape(SHAPE)
    PIL.Image.fromarray(np.round(65535 * light**power).astype(np.uint16)).save(path, pnginfo=info)
    if power == 1:
        read_image(path)
        return
    with pytest.warns(NonlinearWarning, match="codes for displays") as told:
        read_image(path)
    advice = str(told[0].message).rpartition("or ")[2]
    exec(advice, {"numpy": np, "thincam_jax": tc})
    linear = read_image(path.with_suffix(".npy")).pixels
    assert np.abs(linear - light).max() < (1e-3 if value else 0.02)


def test_profile_in_a_tiff(tmp_path):
    from PIL import ImageCms

    path = tmp_path / "capture.tif"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    PIL.Image.fromarray(np.full((*SHAPE, 3), 7, np.uint8)).save(path, icc_profile=profile)
    with pytest.warns(NonlinearWarning, match="codes for displays"):
        read_image(path)


def test_cmyk(tmp_path):
    PIL.Image.fromarray(np.full((*SHAPE, 4), 7, np.uint8), "CMYK").save(tmp_path / "c.jpg")
    with pytest.raises(CaptureFileError, match="stores colours as CMYK"):
        read_image(tmp_path / "c.jpg")


@pytest.mark.parametrize("camera", [spots, diffuser, cells, zones])
def test_a_background_above_the_light(camera):
    """Said where it costs more than 1 dB, not of the right one, as a number or a frame."""
    psf, capture = map(Raw, light_of(camera))
    frame = DARK + 3 * np.random.default_rng(5).normal(size=SHAPE)
    for right in (DARK, Raw(np.round(frame).astype(np.uint16))):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            prepare(psf, capture, background=right)
    wrong = 1000 if camera is zones else 300
    with pytest.warns(UserWarning, match="darker than the background that was given"):
        prepare(psf, capture, background=wrong)


def test_sizes_that_differ(tmp_path):
    """`thincam examine` finds what `thincam reconstruct` refuses."""
    psf, capture = light_of(spots)
    for name, image in (("psf", np.ascontiguousarray(psf.T)), ("capture", capture)):
        tifffile.imwrite(tmp_path / f"{name}.tif", image)
    files = [str(tmp_path / "capture.tif"), "--psf", str(tmp_path / "psf.tif"), "--strict"]
    result = CliRunner().invoke(cli.app, ["examine", *files])
    assert result.exit_code == 2 and "0.75 times the PSF's rows" in result.stdout
    assert not examine([Raw(capture)], Raw(psf)).findings
    with pytest.raises(MeasurementError, match="64×48"):
        prepare(Raw(np.ascontiguousarray(psf.T)), Raw(capture))


@pytest.mark.parametrize("lines", [np.s_[:, 31], np.s_[20:22]])
def test_dead_lines_whose_background_was_subtracted(lines):
    """They are 0, amid the noise around 0."""
    psf, capture = (image.astype(np.float32) - DARK for image in light_of(spots))
    assert not stuck(capture).any()
    for image in (psf, capture):
        image[lines] = 0
        found = stuck(image)
        assert found[lines].all() and found.sum() == found[lines].size
    columns = np.broadcast_to(np.arange(64.0), SHAPE)  # a code along one axis
    assert not stuck(columns.astype(np.float32))[:, 1:-1].any()


@pytest.mark.parametrize("camera", [spots, diffuser, cells, zones])
def test_unsigned_counts_below_their_background(camera):
    """A black level subtracted in uint16 makes dark pixels the brightest ones."""
    psf, capture = light_of(camera)
    below = psf - np.uint16(DARK)
    with pytest.raises(MeasurementError, match="negative numbers in uint16"):
        Raw(below)
    with pytest.raises(ValueError, match=r"negative .* subtract from image.astype\(float\)"):
        tc.Psfs(below[None])
    if camera is spots:  # whose capture has dark pixels
        with pytest.raises(ValueError, match="a capture: .* negative numbers in uint16"):
            tc.Recording([capture - np.uint16(DARK)], tc.Psfs(psf[None]))
    for clean in (psf, capture, 16 * capture, np.maximum(psf, DARK) - np.uint16(DARK)):
        assert not wrapped(clean)
    full = np.random.default_rng(0).integers(0, 2**16, (160, 200)).astype(np.uint16)
    assert not wrapped(full) and not wrapped(np.where(full > 40000, 65535, full // 999))


def of_files(psf, capture, **given):
    recording = tc.Recording([capture], tc.Psfs(psf[None]), **given)
    result = tc.reconstruct(recording, tc.AdmmTV(iterations=60))
    return np.asarray(result.image), result.reason


def test_a_result_is_an_array_for_numpy():
    psf, capture = light_of(spots)
    result = tc.reconstruct(tc.Recording([capture], tc.Psfs(psf[None])), "ridge")
    assert np.array_equal(np.asarray(result), np.asarray(result.image))
    assert np.asarray(result, np.float16).dtype == np.float16 and np.mean(result).shape == ()


def test_a_noise_that_is_too_large():
    """Without it the image is as good as it can be."""
    psf, capture = (image.astype(np.float32) - DARK for image in light_of(spots))
    right, said = of_files(psf, capture)
    assert "noise_variance" not in said
    assert "noise_variance" not in of_files(psf, capture, noise_variance=100.0)[1]
    wrong, said = of_files(psf, capture, noise_variance=1e6)
    assert "noise_variance is too large: 1e+06 of which" in said

    def central(image):
        first = [(n - m) // 2 for n, m in zip(image.shape, SHAPE, strict=True)]
        return image[first[0] : first[0] + SHAPE[0], first[1] : first[1] + SHAPE[1]]

    assert quality(central(wrong), TRUE) < quality(central(right), TRUE) - 3


def test_a_psf_below_zero_or_of_another_shape():
    psf, capture = (image.astype(np.float32) - DARK for image in light_of(spots))
    said = of_files(psf - psf.mean(), capture)[1]
    assert "too large a background was subtracted; give tc.Psfs(psfs + " in said
    back = float(said.rpartition("psfs + ")[2].partition(")")[0])
    assert "too large a background" not in of_files(psf - psf.mean() + back, capture)[1]
    turned = tc.Recording([np.ascontiguousarray(capture.T)], tc.Psfs(psf[None]))
    said = tc.reconstruct(turned).reason
    assert "the PSF has 48×64 pixels and the captures 64×48: give both" in said


def camera(**other):
    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    return tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), 5.0).replace(**other)


def picture(distance=250.0, width=40.0):
    return tc.Scene(tc.ImagePlane(np.eye(16), distance, width), 500 * nm)


@pytest.mark.parametrize(
    ("optics", "view"),
    [({}, {"width": 0.04}), ({"distance": 0.005}, {}), ({}, {"distance": 2.5e5})],
)
def test_lengths_in_metres_or_micrometres(optics, view):
    """A photograph within a pixel is black but for a point; a point of light is meant so."""
    with pytest.warns(SamplingWarning, match="none of it is seen; give lengths in mm"):
        tc.record(camera(**optics), picture(**view))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.record(camera(), picture())
        tc.record(camera(), tc.Scene(tc.ImagePlane([[1.0]], 250.0, 0.04), 500 * nm))


def test_a_mask_in_micrometres():
    for mask in (tc.FresnelZoneAperture(1e-3, width=1600.0), tc.SampledMask(np.eye(8), 200.0)):
        with pytest.warns(SamplingWarning, match="1.6e\\+03 mm wide, 1000 times the sensor"):
            tc.capture(camera(mask=mask), picture())


@pytest.mark.parametrize("view", [{"distance": 0.25}, {"width": 4e4}])
def test_a_scene_cast_far_beyond_the_sensor(monkeypatch, view):
    monkeypatch.setattr("thincam_jax._core.memory.available_bytes", lambda: 10**7)
    with pytest.raises(MemoryError, match="times as wide as the sensor: give lengths in mm"):
        tc.capture(camera(), picture(**view))


@pytest.mark.parametrize("noise", [0, -5.0])
def test_noise_in_place_of_none(noise):
    with pytest.raises(ValueError, match="give None for none, or tc.GaussianNoise"):
        tc.record(camera(), picture(), noise=noise)
    tc.record(camera(), picture(), noise=tc.GaussianNoise(noise))


def test_an_array_in_place_of_a_file():
    image = np.ones((6, 8, 3), np.uint8)
    with pytest.raises(TypeError):  # in other words where types are checked, as here
        tc.Scene.photograph(image, distance=250.0, width=40.0)  # pyright: ignore
    assert tc.Scene(tc.ImagePlane(image, 250.0, 40.0), 550e-6).planes[0].image.shape == (3, 6, 8)


def test_a_filter_of_two_planes():
    scene = tc.Scene([picture().planes[0], picture(100.0, 16.0).planes[0]], 500 * nm)
    recording = tc.record(camera(), scene)
    with pytest.raises(ValueError, match="several planes, which a filter does not separate"):
        tc.reconstruct(recording, "wiener")
    tc.reconstruct(recording, tc.AdmmTV(iterations=2))


def test_a_number_of_a_part():
    """The advice changes it."""
    made = camera()
    with pytest.raises(TypeError, match=r"has no beta; give mask=….mask.replace\(beta=…\)"):
        made.replace(beta=9.0)
    with pytest.raises(TypeError, match="has no distant; give distance"):
        made.replace(distant=9.0)
    assert float(made.replace(mask=made.mask.replace(beta=9.0)).mask.beta) == 9.0
    with pytest.raises(AttributeError, match="did you mean FresnelZoneAperture"):
        tc.FZA(25.0)


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ("hologram", {"wavelength": 532.0}),
        ("hologram", {"thickness": 16.0}),
        ("hologram", {"thickness": 16e-6}),
        ("screen", {"glass_thickness": 5000.0}),
        ("camera", {"focal_distance": 0.006}),
        ("camera", {"focal_distance": 6000.0}),
    ],
)
def test_a_screen_in_other_units(part, wrong):
    def made(**changed):
        film = {"wavelength": 532 * nm, "thickness": 16 * um} | changed.get("hologram", {})
        angles = {"object_angle": 0.0, "reference_angle": 1.07}
        hologram = wg.VolumeHologram.record(**angles, **film, index=1.5, index_modulation=0.02)
        glass = {"glass_thickness": 5.0} | changed.get("screen", {})
        screen = wg.Screen(hologram=hologram, **glass, glass_index=1.5)
        lens = {"focal_distance": 6.0, "lens_distance": 10.0} | changed.get("camera", {})
        return wg.SeeThroughCamera(screen, tc.Sensor((44, 48), 48 * um), **lens)

    made()
    with pytest.raises(ValueError, match="give it in mm|lengths in mm|is out of range; give"):
        made(**{part: wrong})


def test_a_design_in_other_units():
    def setup(pitch=40 * um, width=1.28, distance=100.0, across=40.0):
        return tc.design.Setup(pitch, width, distance, across)

    for wrong in ({"pitch": 40.0}, {"width": 1280.0 * 1e3}, {"distance": 0.1}, {"across": 4e4}):
        with pytest.raises(ValueError, match="give (it|all) in mm"):
            setup(**wrong)
    with pytest.raises(ValueError, match="cell = 11.0 mm is no pixel: give it in mm"):
        tc.design.CellMasks(11.0, 64, distance=6.5, wavelength=500 * nm)
    with pytest.raises(ValueError, match="the least and the most in mm"):
        tc.design.for_sensor(tc.Sensor((60, 80), 40 * um), distance=(0.003, 0.01))
