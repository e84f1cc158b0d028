"""Working through captures: one compilation for a folder, failures apart, nothing half-written."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from commands.reconstruct import simulated

from helpers import compilations, full_disk, relative_l2
from thincam_jax._core import memory
from thincam_jax.commands.reconstruct import jobs, run
from thincam_jax.commands.reconstruct.jobs import plan_jobs
from thincam_jax.commands.reconstruct.options import Output, Recipe, Sources
from thincam_jax.commands.reconstruct.run import Failed, Finished, run_jobs
from thincam_jax.measured import MeasurementError
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies import prepared

SHORT = Recipe(iterations=16)  # steps of ten and of one


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "captures"
    folder.mkdir()
    simulated.grey_files(folder, ("first", "second", "third"))
    return folder


def sources(folder, **more):
    return Sources(folder / "psf.tif", folder / "dark.tif", bits=12, **more)


def test_folder_is_compiled_once(folder, tmp_path):
    """For captures of other brightness and another mask of valid pixels too."""
    bright = np.asarray(simulated.counts(simulated.psf(), seed=9, full=4300), dtype=np.uint16)
    np.save(folder / "second.npy", bright)
    (folder / "second.tif").unlink()
    output = Output(tmp_path / "out", linear="none")
    planned = plan_jobs(folder, sources(folder), output)
    results = run_jobs(planned, sources(folder), SHORT, output)
    done = [next(results)]
    assert compilations(lambda: done.extend(results)) == 0
    shares = [one.record["preparation"]["valid_share"] for one in done if isinstance(one, Finished)]
    assert len(shares) == 3 and shares[0] == shares[2] == 1 and shares[1] < 1
    assert sorted(p.stem for p in (tmp_path / "out").glob("*.png")) == ["first", "second", "third"]


def test_same_image_as_step_by_step(folder, tmp_path):
    """With the relative residual from its definition, by a direct convolution."""
    output = Output(tmp_path / "first.npy")
    planned = plan_jobs(folder / "first.tif", sources(folder), output)
    whole = Recipe(iterations=16, field="full")
    (result,) = run_jobs(planned, sources(folder), whole, output)
    assert isinstance(result, Finished)
    image = np.load(output.path)
    ready = run.Inputs(sources(folder)).prepare(folder / "first.tif")
    rows, columns = simulated.SHAPE
    light = simulated.scipy.signal.fftconvolve(image, ready.psf[0], mode="valid")
    assert light.shape == (rows, columns)
    expected = relative_l2(light, ready.capture[0])
    written = json.loads((tmp_path / "first.json").read_text("utf-8"))
    told = written["reconstruction"]["relative_data_residual"]
    assert told == pytest.approx(expected, rel=1e-3)
    assert float(result.record["reconstruction"]["relative_data_residual"]) == pytest.approx(told)


@pytest.mark.parametrize("room", [1_000, 10_000])
def test_nothing_is_left_of_a_write_that_fails(folder, tmp_path, monkeypatch, room):
    """Of the first or the last file. Not even what stood there before is touched."""
    output = Output(tmp_path / "first.png")
    output.path.write_text("before", "utf-8")

    def limited(*given):
        with full_disk(room):
            jobs.write_job(*given)

    monkeypatch.setattr(run, "write_job", limited)
    planned = plan_jobs(folder / "first.tif", sources(folder), output)
    (result,) = run_jobs(planned, sources(folder), SHORT, output)
    assert isinstance(result, Failed)
    assert str(result.error).startswith(
        f"{output.path}: cannot be written (File too large); make room or give another folder"
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["captures", "first.png"]
    assert output.path.read_text("utf-8") == "before"


def test_what_overflows_is_not_written(folder, tmp_path, monkeypatch):
    lost = Reconstruction(jnp.full((1, 2, 3), jnp.nan), None, ended="iterations_exhausted")
    monkeypatch.setattr(prepared, "solved", lambda *_, **__: lost)
    output = Output(tmp_path / "first.png")
    planned = plan_jobs(folder / "first.tif", sources(folder), output)
    (result,) = run_jobs(planned, sources(folder), Recipe(tau=1e5), output)
    assert isinstance(result, Failed)
    assert "became NaN or infinite" in str(result.error) and "tau (now 100000)" in str(result.error)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["captures"]


def test_more_than_the_memory(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 10**6)
    output = Output(tmp_path / "first.png")
    planned = plan_jobs(folder / "first.tif", sources(folder), output)
    (result,) = run_jobs(planned, sources(folder), SHORT, output)
    assert isinstance(result, Failed) and isinstance(result.error, MemoryError)
    assert "its reconstruction on" in str(result.error)
    assert str(result.error).endswith("give a larger downsample")


class TestPlan:
    def test_captures_are_all_images_but_the_sources(self, folder, tmp_path):
        """Hidden files, folders and other files are none."""
        for name in (".hidden.tif", "notes.txt"):
            (folder / name).write_bytes(b"")
        (folder / "folder.tif").mkdir()
        planned = plan_jobs(folder, sources(folder), Output(tmp_path / "out", linear="tif"))
        assert [job.capture.name for job in planned] == ["first.tif", "second.tif", "third.tif"]
        names = [path.relative_to(tmp_path).as_posix() for path in planned[0].images]
        assert names == ["out/first.png", "out/first.tif"]
        assert not (tmp_path / "out").exists()
        plan_jobs(folder, sources(folder), Output(tmp_path / "more" / "out"))  # can be made

    @pytest.mark.parametrize(
        ("out", "message"),
        [
            ("captures", "holds the captures"),
            ("file.png", "is a file; for a folder of captures give a folder"),
        ],
    )
    def test_output_of_a_folder(self, folder, tmp_path, out, message):
        (tmp_path / "file.png").write_text("mine", "utf-8")
        with pytest.raises(MeasurementError, match=message):
            plan_jobs(folder, sources(folder), Output(tmp_path / out))
        assert (tmp_path / "file.png").read_text("utf-8") == "mine"

    def test_two_of_one_name(self, folder, tmp_path):
        (folder / "second.png").write_bytes(b"")
        with pytest.raises(MeasurementError, match=r"second.tif and second.png would both become"):
            plan_jobs(folder, sources(folder), Output(tmp_path / "out"))

    def test_output_beside_that_is_taken(self, folder, tmp_path):
        """By an input, or by a folder."""
        with pytest.raises(MeasurementError, match="first.tif: is read as an input"):
            output = Output(folder / "first.png", linear="tif")
            plan_jobs(folder / "first.tif", sources(folder), output)
        (tmp_path / "image.npy").mkdir()
        with pytest.raises(MeasurementError, match=r"image\.npy: is a folder"):
            plan_jobs(folder / "first.tif", sources(folder), Output(tmp_path / "image.png"))
