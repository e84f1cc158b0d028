"""The benchmark of accuracy of a tiny study: sizes, folder, and what accuracy.json holds."""

import json

import jax
import pytest
from commands.study import tiny
from studies import tiny as in_python

from thincam_jax.commands import accuracy
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.studies.psf_error_cost import measure_accuracy

SIZES = (32,)  # of the sensor's 64


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return tiny.study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def run(config, tmp_path_factory):
    """Folder and contents of accuracy.json of one run."""
    folder = accuracy.BenchFolder(tmp_path_factory.mktemp("out") / "new")
    plan = accuracy.check(config, SIZES, 48)
    told = tiny.Told()
    accuracy.run_accuracy(plan, folder, told)
    assert len(told) == told.total
    assert sorted(p.name for p in folder.path.iterdir()) == [
        ".lock",
        "accuracy.json",
        "config.yaml",
    ]
    return json.loads((folder.path / "accuracy.json").read_text("utf-8"))


@pytest.mark.thorough
def test_settings_and_machine(run, config):
    settings, machine = run["settings"], run["machine"]
    assert settings["sizes"] == list(SIZES)
    assert settings["camera"]["beta_rad_per_mm2"] == 25.0
    assert settings["target"] == "picture"
    assert machine["jax"] == jax.__version__
    assert machine["cores"] >= 1
    assert run["config"] == dump_config(config)


@pytest.mark.thorough
def test_the_file_gives_the_numbers_of_the_same_study_in_python(run):
    found = measure_accuracy(in_python.study(), SIZES, 48)
    assert [row["true_error"] for row in run["psfs"]] == [row.true_error for row in found.psfs]
    assert [row.get("error") for row in run["captures"]] == [row.error for row in found.captures]
    told, costs = run["reconstructions"], found.reconstructions
    assert told["exact_psnr_db"] == costs.exact_psnr_db
    lost = [row.psnr_lost_db for row in (*costs.models, *costs.controlled)]
    assert [row.get("psnr_lost_db") for row in told["models"] + told["controlled"]] == lost


class TestSizes:
    def test_default_sizes(self, config):
        def large(n):
            return config.sensor.model_copy(update={"shape": (n // 2, n)})

        for own, sizes in (
            (config.sensor, (64,)),
            (large(512), (128, 256, 512)),
            (large(1000), (128, 256, 512, 1000)),
        ):
            assert accuracy.sizes_of_psfs((), own) == sizes
        assert accuracy.sizes_of_psfs((300, 200, 300), large(1000)) == (200, 300)
        assert max(accuracy.check(config).case.study.sensor.shape) == 64

    @pytest.mark.parametrize("size", [0, -3, 65])
    def test_refused(self, config, size):
        for options in (((size,),), ((), size)):
            with pytest.raises(ConfigError, match=f"size = {size}: "):
                accuracy.check(config, *options)

    def test_too_few_pixels_to_reconstruct(self, config):
        with pytest.raises(ConfigError, match="^--capture-size 5: "):
            accuracy.check(config, (), 5)


class TestFolder:
    """Every other fault of a folder is tested where runs and sweeps claim theirs."""

    @pytest.mark.parametrize("name", ["thesis.txt", "accuracy.json"])
    def test_foreign_files_stay(self, config, tmp_path, name):
        (tmp_path / name).write_text("mine", "utf-8")
        with pytest.raises(ConfigError, match="is not empty and holds no benchmark"):
            accuracy.BenchFolder(tmp_path).claim(config)
        assert (tmp_path / name).read_text("utf-8") == "mine"
        assert [p.name for p in tmp_path.iterdir()] == [name]

    def test_done_anew_only_with_the_same_configuration(self, config, tmp_path):
        folder = accuracy.BenchFolder(tmp_path / "deep" / "new")
        folder.claim(config)
        folder.write("accuracy.json", "{}")
        folder.claim(config)
        with pytest.raises(ConfigError, match="a benchmark of another configuration"):
            folder.claim(config.model_copy(update={"seed": 7}))

    def test_a_file_in_the_way(self, config, tmp_path):
        (tmp_path / "file").write_text("mine", "utf-8")
        with pytest.raises(ConfigError, match="cannot be made a folder"):
            accuracy.BenchFolder(tmp_path / "file").claim(config)
