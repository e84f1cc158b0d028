"""`thincam reconstruct --camera`: a camera's numbers in place of a measured PSF."""

import numpy as np
import pytest
from commands.reconstruct import simulated
from commands.reconstruct.test_command import one_line, record_of, runner
from commands.study import tiny

import thincam_jax as tc
from helpers import ROOT, relative_l2
from thincam_jax.commands import cli
from thincam_jax.commands.reconstruct.options import read_camera
from thincam_jax.studies.evaluate import take
from thincam_jax.studies.prepared import computed_psf


@pytest.fixture
def files(tmp_path):
    """A study, a capture of 12 bit by its first shot, and that shot's PSF as a file."""
    study = tiny.built(tmp_path, "object.distance=40 mm")
    seen = np.asarray(take(study, study.exposures[0], study.targets[1]).image)[1]
    simulated.write_tiff(tmp_path / "capture.tif", simulated.counts(seen))
    whole = computed_psf(read_camera(tmp_path / "tiny.yaml", ("object.distance=40 mm",)), "tiny")
    np.save(tmp_path / "psf.npy", whole.pixels)  # also what the shadow has beyond the sensor
    names = {"study": "tiny.yaml", "capture": "capture.tif", "psf": "psf.npy"}
    return {name: tmp_path / file for name, file in names.items()}


def reconstruct(files, *more):
    given = ("--capture", files["capture"], "--out", files["study"].with_name("image.npy"))
    known = ("--bits", 12, "--background", simulated.DARK, "--method", "ridge")
    typed = ["reconstruct", *given, *known, *more]
    return runner.invoke(cli.app, [str(part) for part in typed])


@pytest.mark.thorough
def test_it_is_as_good_as_a_perfect_measurement(files):
    by_psf = ("--psf", files["psf"], "--psf-background", 0, "--psf-scale", 1)
    by_camera = ("--camera", files["study"], "--set", "object.distance=40mm")
    images = []
    for known in (by_psf, by_camera, by_camera[:2]):
        result = reconstruct(files, *known)
        assert result.exit_code == 0, result.output
        images.append(np.load(files["study"].with_name("image.npy")))
    assert relative_l2(images[1], images[0]) < 0.01
    assert relative_l2(images[2], images[0]) > 0.1  # focused on 100 mm
    psf = record_of(files["study"].with_name("image.npy"))["sources"]["psf"]
    assert "beta=25 rad/mm²" in psf and "distance=3 mm" in psf and "object at 100 mm" in psf


@pytest.mark.thorough
def test_what_does_not_go_together(files):
    for known, message in (
        ((), "give either --psf, a measured PSF, or --camera"),
        (("--psf", files["psf"], "--camera", files["study"]), "give either --psf"),
        (("--psf", files["psf"], "--set", "seed=1"), "--set changes the file of --camera"),
        (("--camera", files["study"], "--set", "sensor.shape=[64,64]"), "has 64×64 pixels and"),
        (("--camera", ROOT / "configs" / "fza_refocus.yaml"), "a camera is read from a study"),
    ):
        assert message in one_line(reconstruct(files, *known))
    given = ("--capture", files["capture"], "--out", files["study"].with_name("a.png"))
    typed = ("reconstruct", *given, "--camera", files["study"])
    result = runner.invoke(cli.app, [str(part) for part in (*typed, "--background", "corner")])
    assert "the PSF's corner says nothing about it" in one_line(result)


@pytest.mark.thorough
def test_psf_of_a_mask_larger_than_the_sensor_is_whole(files):
    wide = ("mask.width=5mm", "--set", "object.distance=40mm")
    cameras = read_camera(files["study"], wide[::2])
    found = computed_psf(cameras, "tiny")
    (camera,) = cameras.cameras
    camera = camera.on_grid(camera.sensor.grid.with_shape((200, 200)))
    how = {"wavelength": cameras.wavelength, "object_distance": 40.0, "pixel_integration": False}
    whole = np.asarray(tc.psf(camera, model="geometric", **how))
    rows, columns = ((200 - n) // 2 for n in found.pixels.shape)
    np.testing.assert_allclose(found.pixels, whole[rows : 200 - rows, columns : 200 - columns])
    np.testing.assert_allclose(found.pixels.sum(), whole.sum())
    assert found.sensor_shape == (48, 64) and min(found.pixels.shape) > 64
    out = files["study"].with_name("image.npy")
    result = reconstruct(files, "--camera", files["study"], "--set", *wide)
    assert result.exit_code == 0, result.output
    assert np.load(out).shape == (48, 64)
    assert record_of(out)["preparation"]["psf_shape"] == list(found.pixels.shape)
