"""The trained reconstruction that comes with the package: its card, its camera, its images."""

import jax.numpy as jnp
import numpy as np
import pytest
from learn.commands.test_train_denoiser import line
from typer.testing import CliRunner

import thincam_jax as tc
from helpers import ROOT
from thincam_jax import measured
from thincam_jax.commands import cli
from thincam_jax.learn.sources import from_json
from thincam_jax.learn.trained import _SHIPPED_FILE, SHIPPED, TrainedReconstruction, training_record
from thincam_jax.studies.agreement import agreement

DATA = ROOT.parent / "shared/data"
HAND, PHOTOGRAPHS = DATA / "diffusercam-hand", DATA / "photographs/cc-by-sa/validation"
FREE = ("CC0 1.0", "drawn", "scikit-image's own (its data folder's README)")


def prepared(capture):
    """The tutorial's PSF and a capture of it, in the pixels of the training."""
    psf, seen = (measured.read_image(HAND / name) for name in ("psf_sample.tif", capture))
    options = measured.Preparation(downsample=8)
    return measured.prepare(psf, seen, background="corner", options=options)


def test_what_is_shipped_may_be_given_on():
    """Each picture by its licence; those that judged are none of those that trained."""
    record = training_record(SHIPPED)
    images = from_json(record["images"])
    assert {one.licence for entries in images.values() for one in entries} <= set(FREE)
    assert not {one.sha256 for one in images["trained on"]} & {
        one.sha256 for one in images["judged on"]
    }
    assert "BSD-3-Clause" in record["psf"]["licence"]
    notice = _SHIPPED_FILE.with_suffix(".LICENSE").read_text("utf-8")
    assert "Copyright (c) 2018, Waller Lab" in notice and "CC0 1.0" in notice
    assert _SHIPPED_FILE.stat().st_size < 4e6


def test_another_camera_is_refused_by_name(tmp_path):
    """By its PSF's pixels, by its PSF, and in the shell."""
    trained = TrainedReconstruction.load(SHIPPED)
    assert trained.camera is not None and trained.camera.psf_shape == (150, 200)
    rng = np.random.default_rng(0)
    for shape, text in (((30, 40), "150×200"), ((150, 200), "it is another camera")):
        psf = rng.random(shape).astype(np.float32) ** 12
        recording = tc.Recording(np.ones((1, *shape)), tc.Psfs(psf[None]), noise_variance=0.01)
        with pytest.raises(ValueError, match=text):
            tc.reconstruct(recording, trained)
    np.save(tmp_path / "psf.npy", psf)
    np.save(tmp_path / "capture.npy", 100 + 900 * rng.random((150, 200), np.float32))
    files = "--psf", tmp_path / "psf.npy", "--capture", tmp_path / "capture.npy"
    words = *files, "--background", "0", "--out", tmp_path / "a.npy", "--method", SHIPPED
    told = line(CliRunner().invoke(cli.app, ["reconstruct", *map(str, words)]))
    assert "it is another camera; train for this one, or use AdmmTV" in told


@pytest.mark.thorough
@pytest.mark.skipif(not (HAND.exists() and PHOTOGRAPHS.exists()), reason=f"needs {DATA}")
def test_it_is_better_than_total_variation():
    """On captures with hidden faults of photographs that it has not seen."""
    from thincam_jax.learn.denoiser.pictures import united
    from thincam_jax.learn.trained_lessons import CameraLessons, photographs

    psf = prepared("psf_sample.tif").psf
    camera = CameraLessons(psf, (150, 200), united(list(photographs(PHOTOGRAPHS).values())))
    trained, gains = TrainedReconstruction.load(SHIPPED), []
    for number in range(4):
        recording, scene = camera.drawn(4242, number)
        top, left = ((n - m) // 2 for n, m in zip(scene.shape[1:], (150, 200), strict=True))
        truth = scene[:, top : top + 150, left : left + 200]
        found = (tc.reconstruct(recording, one).image for one in (tc.AdmmTV(), trained))
        before, after = (agreement(np.asarray(image, np.float32), truth).psnr_db for image in found)
        gains.append(after - before)
    assert np.mean(gains) > 0.5


@pytest.mark.thorough
@pytest.mark.skipif(not HAND.exists(), reason=f"needs {HAND}")
def test_the_hand_is_that_of_total_variation():
    """A bright hand on black, in the unit of the other methods."""
    ready = prepared("rawdata_hand_sample.tif")
    recording = tc.Recording([ready.capture], tc.Psfs(ready.psf[None]))
    trained, known = (
        np.asarray(tc.reconstruct(recording, method).image)[0]
        for method in (TrainedReconstruction.load(SHIPPED), tc.AdmmTV())
    )
    assert np.corrcoef(trained.ravel(), known.ravel())[0, 1] > 0.95
    assert float(jnp.abs(trained.mean() / known.mean() - 1)) < 0.2
