"""The whole benchmark on a tiny study, against an independent recomputation."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands.study import tiny

import thincam_jax as tc
from thincam_jax.commands.accuracy import cameras
from thincam_jax.commands.accuracy import run as accuracy
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.study.build import build_study

SIZES = (32,)  # of the sensor's 64


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return tiny.study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def run(config, tmp_path_factory):
    """Folder and results of one run, and what it told."""
    folder = accuracy.BenchFolder(tmp_path_factory.mktemp("out") / "new")
    plan = accuracy.check(config, accuracy.Sizes(SIZES, 48))
    told = tiny.Told()
    results = accuracy.run_accuracy(plan, folder, told)
    assert len(told) == told.total
    return folder.path, results


@pytest.mark.thorough
def test_files(run):
    path, results = run
    assert sorted(p.name for p in path.iterdir()) == [
        "accuracy.json",
        "accuracy.png",
        "config.yaml",
    ]
    assert json.loads((path / "accuracy.json").read_text("utf-8")) == results
    assert (path / "accuracy.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.thorough
def test_settings_and_machine(run, config):
    settings, machine = run[1]["settings"], run[1]["machine"]
    assert settings["sizes"] == list(SIZES)
    assert settings["camera"]["beta_rad_per_mm2"] == 25.0
    assert settings["target"] == "picture"
    assert machine["jax"] == jax.__version__
    assert machine["cores"] >= 1
    assert run[1]["config"] == dump_config(config)


def own_psf(config, size, model, precision, **how):
    """The PSF of the binned camera, without the package's benchmark."""
    ratio = 64 / size
    pitch = float(np.float32(0.04 * ratio))
    shape = (round(48 / ratio), round(64 / ratio))
    mask = tc.FresnelZoneAperture(jnp.float32(25.0), jnp.float32(0.0), width=jnp.float32(2.0))
    mask = jax.tree.map(lambda x: x.astype(precision), mask)
    camera = tc.LenslessCamera(
        mask, tc.Sensor(shape, jnp.asarray(pitch, precision)), jnp.asarray(3.0, precision)
    )
    return np.asarray(
        tc.psf(
            camera,
            wavelength=jnp.asarray(float(np.float32(500e-6)), precision),
            object_distance=jnp.asarray(100.0, precision),
            model=model,
            pixel_integration=False,
            **how,
        ),
        float,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("size", SIZES)
def test_errors_agree_with_a_recomputation(run, config, size):
    exact = own_psf(config, size, "separable", "float64")
    rows = [r for r in run[1]["psfs"] if max(r["shape"]) == size and r["status"] == "run"]
    assert {r["model"] for r in rows} == set(tc.MODELS)
    for row in rows:
        if row["oversampling"] == 3 and row["precision"] == "float64":
            continue  # for the time it takes
        how = {"oversampling": row["oversampling"]} if row["oversampling"] else {}
        h = own_psf(config, size, row["model"], row["precision"], **how)
        error = np.linalg.norm(h - exact) / np.linalg.norm(exact)
        if row["true_error"] == 0:
            assert (row["model"], row["precision"], error < 1e-13) == ("separable", "float64", True)
        else:
            assert row["true_error"] == pytest.approx(error, rel=0.2 if error < 1e-5 else 1e-3)


@pytest.mark.thorough
def test_every_way_is_told(run):
    rows = run[1]["psfs"]
    ways = {(r["model"], r["precision"], r["oversampling"], max(r["shape"])) for r in rows}
    assert len(ways) == len(rows) == len(SIZES) * 2 * (4 + 2 + 2)
    for row in rows:
        assert row["flops"] > 0
        assert row["bytes"] > 0
        ran = row["status"] == "run"
        assert ran == (row["reason"] is None) == (row["calls"] > 0)
        if ran:
            assert row["seconds"] > 0
            assert row["compile_seconds"] > 0
            assert row["predicted_error"] >= 0.5 * row["true_error"]


@pytest.mark.thorough
def test_captures_agree_with_a_recomputation(run, config):
    rows = {r["model"]: r for r in run[1]["captures"]}
    study = cameras.binned(build_study(config), 48)
    (method,) = [m for m in study.methods if m.solver.name == "wiener"]
    camera = study.camera(method.exposures[0])
    scene = tc.Scene(study.targets[1].plane, method.exposures[0].wavelength)
    exact, shadow = (
        np.asarray(tc.capture(camera, scene, model=m, pixel_integration=False), float)
        for m in ("separable", "geometric")
    )
    error = np.linalg.norm(shadow - exact) / np.linalg.norm(exact)
    assert rows["geometric"]["error"] == pytest.approx(error, rel=1e-3)
    exact, shadow = (i - i.mean(axis=(-2, -1), keepdims=True) for i in (exact, shadow))
    error = np.linalg.norm(shadow - exact) / np.linalg.norm(exact)
    assert rows["geometric"]["contrast_error"] == pytest.approx(error, rel=1e-3)
    assert rows["separable"]["contrast_error"] < 1e-4


@pytest.mark.thorough
def test_reconstructions(run):
    found = run[1]["reconstructions"]
    assert found["skipped"] is None
    rows = {r["model"]: r for r in found["models"]}
    for row in rows.values():
        if row["status"] == "run":
            lost = found["exact_psnr_db"] - row["psnr_db"]
            assert row["psnr_lost_db"] == pytest.approx(lost, abs=1e-9)
    assert abs(rows["separable"]["psnr_lost_db"]) < 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", ["beta", "distance"])
def test_controlled_errors(run, wrong):
    """Each hits its level; the larger the error of β the more PSNR is lost.

    A wrong d also changes how strong the fringes are taken to be, and can gain by it.
    """
    rows = [r for r in run[1]["reconstructions"]["controlled"] if r["wrong"] == wrong]
    assert [r["level"] for r in rows] == [0.003, 0.01, 0.03, 0.1]
    for row in rows:
        assert row["psf_error"] == pytest.approx(row["level"], rel=0.05)
    lost = [r["psnr_lost_db"] for r in rows]
    if wrong == "beta":
        assert lost == sorted(lost)
        assert lost[-1] > 0
    assert [r["capture_contrast_error"] for r in rows][0] < rows[-1]["capture_contrast_error"]


class TestSizes:
    @pytest.mark.parametrize("size", [7, 16, 33, 64])
    def test_binning_keeps_the_area(self, config, size):
        built = build_study(config)
        study = cameras.binned(built, size)
        sensor, whole = study.sensor, config.sensor
        assert max(sensor.shape) == size
        sides = [n * study.pitch for n in sensor.shape]
        assert sides[1] == pytest.approx(64 * whole.pitch, rel=1e-12)
        assert sides[0] == pytest.approx(48 * whole.pitch, abs=study.pitch / 2 + 1e-12)
        assert study.mask is built.mask

    def test_default_sizes(self, config):
        def large(n):
            return config.sensor.model_copy(update={"shape": (n // 2, n)})

        assert cameras.sizes_of(config.sensor, ()) == (64,)
        assert cameras.sizes_of(large(512), ()) == (128, 256, 512)
        assert cameras.sizes_of(large(1000), ()) == (128, 256, 512, 1000)
        assert cameras.sizes_of(large(1000), (300, 200, 300)) == (200, 300)
        assert cameras.capture_size_of(config.sensor, None) == 64
        assert cameras.capture_size_of(large(1000), None) == 256

    @pytest.mark.parametrize("size", [0, -3, 65])
    def test_refused(self, config, size):
        for options in (accuracy.Sizes((size,)), accuracy.Sizes((), size)):
            with pytest.raises(ConfigError, match=f"size {size}: "):
                accuracy.check(config, options)

    def test_too_few_pixels_to_reconstruct(self, config):
        with pytest.raises(ConfigError, match="^--capture-size 5: "):
            accuracy.check(config, accuracy.Sizes((), 5))


def test_without_wiener(config):
    """Fringe scanning assumes no PSF: told, not run."""
    alone = config.model_copy(update={"methods": config.methods[:1]})
    plan = accuracy.check(alone, accuracy.Sizes(SIZES))
    assert plan.case.skipped == "conventional: fringe scanning assumes no PSF"


class TestFolder:
    """Every other fault of a folder is tested where runs and sweeps claim theirs."""

    @pytest.mark.parametrize("name", ["thesis.txt", "accuracy.json", "accuracy.png"])
    def test_foreign_files_stay(self, config, tmp_path, name):
        (tmp_path / name).write_text("mine")
        with pytest.raises(ConfigError, match="is not empty and holds no benchmark"):
            accuracy.BenchFolder(tmp_path).claim(config)
        assert (tmp_path / name).read_text() == "mine"
        assert [p.name for p in tmp_path.iterdir()] == [name]

    def test_done_anew_only_with_the_same_configuration(self, config, tmp_path):
        folder = accuracy.BenchFolder(tmp_path / "deep" / "new")
        folder.claim(config)
        folder.finish({"bench": "accuracy"}, b"picture")
        folder.claim(config)
        with pytest.raises(ConfigError, match="a benchmark of another configuration"):
            folder.claim(config.model_copy(update={"seed": 7}))

    def test_a_file_in_the_way(self, config, tmp_path):
        (tmp_path / "file").write_text("mine")
        with pytest.raises(ConfigError, match="cannot be made a folder"):
            accuracy.BenchFolder(tmp_path / "file").claim(config)
