"""`thincam capture` on the virtual rig, through the protocols of its devices, and `thincam run`."""

import importlib.metadata
import json
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from commands.pages import assert_says_its_result
from commands.test_cli import call, called, one_line
from hardware.commands import tiny

from helpers import quick, read_fiducial, recipe
from thincam_jax.hardware import registry
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.commands import command
from thincam_jax.hardware.displays.patterns import pattern_levels
from thincam_jax.hardware.registry import driver_report
from thincam_jax.hardware.virtual.rig import pattern_number
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.measured.calibration.system_matrix import open_matrix, read_matrix


@pytest.fixture(autouse=True)
def devices_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # where held devices are noted


@pytest.fixture(scope="module")
def method_b(tmp_path_factory):
    """The file and the store of a capture, taken once."""
    folder = tmp_path_factory.mktemp("rig")
    file = tiny.write(folder)
    result = called("capture", file, "--out", folder / "a.zarr")
    assert f"{folder / 'a.zarr'}: 6 frames; next: thincam run" in result.stdout.replace("\n", "")
    return file, folder / "a.zarr"


@pytest.mark.thorough
def test_an_image_of_captures_agrees_with_direct_simulation(method_b, tmp_path):
    """Frames and image, within the noise, by a model that the virtual rig does not use."""
    called("run", method_b[1], "--out", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "metrics.json").read_text("utf-8"))
    agreement = found["agreement"]
    for residual, bias in zip(
        agreement["frame_residual_over_noise"], agreement["frame_bias_over_noise"], strict=True
    ):
        assert abs(residual - 1) < 0.04  # 64·96 pixels: 0.009
        assert abs(bias) < 0.15  # of the mean of two dark frames, and 0.013
    assert abs(agreement["image_noise_over_simulated"] - 1) < 0.3
    scores = found["psnr_db"]
    assert abs(scores["captured"] - scores["simulated"]) < 1.5
    assert scores["captured"] > 17
    page = assert_says_its_result(tmp_path / "out")
    assert page.count("data:image/webp") == 4 and "frames differ by 1.0" in page
    assert (tmp_path / "out/images/scene.png").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("light", ["", tiny.DISPLAY_LIGHT])
def test_a_matrix_of_captures_agrees_with_direct_simulation(light, tmp_path):
    """With light of a display behind the plate by its shot noise, which is in no calibration."""
    file = tiny.write(tmp_path, tiny.HADAMARD + light)
    called("capture", file, "--out", tmp_path / "a.zarr")
    called("run", tmp_path / "a.zarr", "--out", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "metrics.json").read_text("utf-8"))
    assert found["frames"] == 2 * 8 * 16 + 2
    assert found["matrix"] == [28 * 40, 8 * 16]
    assert abs(found["agreement"]["matrix_residual_over_noise"] - 1) < 0.02
    assert found["agreement"]["largest_counts"] > 100 * found["agreement"]["noise_counts"]
    matrix = read_matrix(tmp_path / "out" / "matrix.zarr")
    rows = open_matrix(tmp_path / "out" / "matrix.zarr")
    reduced = ReducedMatrix.load(tmp_path / "out" / "reduced.npz", rows)
    values = np.linalg.svd(np.asarray(matrix.matrix), compute_uv=False)
    np.testing.assert_allclose(np.sort(reduced.values)[-20:], values[19::-1], rtol=1e-3)


@pytest.mark.parametrize("devices", quick(["zaber", "grbl", "pylon", "line"], 2))
def test_each_frame_is_of_the_pattern_and_the_place_that_the_plan_says(devices, tmp_path):
    """By any camera and stage: the fiducials of the frames, read back from the store."""
    raw = yaml.safe_load(tiny.METHOD_B)
    raw["virtual"]["fiducial"] = True
    if devices == "pylon":
        raw["camera"]["driver"] = "pylon"
    elif devices == "line":
        raw["camera"]["trigger"] = "Line0"
    else:
        raw["stage"] = {"driver": devices}
        raw["plan"] = {"kind": "method_a", "betas": ["60 rad/mm^2"], "width": "1.44 mm"}
        raw["plan"]["distances"] = ["6.5 mm", "8 mm"]
    file = tiny.write(tmp_path, yaml.safe_dump(raw))
    called("capture", file, "--out", tmp_path / "a.zarr")
    taken = Acquisition.load(tmp_path / "a.zarr")
    seen = set()
    for number, step in enumerate(taken.plan.steps):
        fiducial = read_fiducial(taken.frame(number), taken.bits)
        shown = pattern_levels(taken.plan.pattern(step), (60, 80), 0.036)
        assert fiducial.pattern == pattern_number(shown)
        assert abs(fiducial.position / 1000 - (step.position or 0.0)) < 0.01
        seen.add(fiducial)
    assert len(seen) == len(taken.plan.steps)
    assert taken.settings[0].trigger == raw["camera"].get("trigger", "Software")


def test_a_store_is_not_written_over_and_a_missing_one_begun(method_b, tmp_path):
    """As after a kill before the first frame, when the same line is typed with --resume."""
    file, store = method_b
    assert "exists; --resume goes on" in one_line(call("capture", file, "--out", store))
    called("capture", file, "--out", tmp_path / "b.zarr", "--resume")
    assert Acquisition.load(tmp_path / "b.zarr").plan == Acquisition.load(store).plan
    other = call("capture", file, "--out", store, "--resume", "--set", "plan.dark_frames=1")
    assert "another plan" in one_line(other)
    assert call("capture", file, "--out", store, "--resume").exit_code == 0  # complete already


def test_an_error_of_a_device_is_one_line_and_how_to_go_on(tmp_path):
    file = tiny.write(tmp_path)
    store = tmp_path / "a.zarr"
    result = call("capture", file, "--out", store, "--set", "virtual.electrons=1e9")
    assert result.exit_code == command.STOPPED
    error, remedy = result.stderr.splitlines()
    assert "of the pixels are full" in error
    assert "1 of 6 frames are kept; go on with: thincam capture" in remedy
    assert remedy.endswith("--resume --set 'virtual.electrons=1e9'")


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("camera.driver=kodak", "kodak: open: there is no virtual one among the cameras; use ara"),
        ("camera.options={gray: 1}", "options: aravis has no option gray; allowed: "),
        ("plan.width=1.476 mm", "plan.width: 41 × 41 pixels cannot be centred on 60 × 80"),
    ],
)
def test_a_rig_that_cannot_be_opened(asked, line, tmp_path):
    file = tiny.write(tmp_path)
    result = call("capture", file, "--out", tmp_path / "a.zarr", "--set", asked)
    assert result.exit_code in (2, command.STOPPED)
    (told,) = result.stderr.splitlines()
    assert line in told
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("plan.distances=[6.5 mm, 506.5 mm]", "5 steps of the plan lie outside, the first at 500"),
        ("camera.exposure=1000 s", "ExposureTime of 1000 s; give "),
        ("camera.region={top: 9, left: 0, height: 64, width: 96}", "lies outside of the sensor"),
    ],
)
def test_the_limits_of_a_rig_hold_for_the_whole_plan_before_the_first_frame(asked, line, tmp_path):
    raw = yaml.safe_load(tiny.METHOD_B) | {"stage": {"driver": "zaber"}}
    raw["plan"] |= {"kind": "method_a", "betas": ["60 rad/mm^2"], "distances": ["6.5 mm"]}
    file, store = tiny.write(tmp_path, yaml.safe_dump(raw)), tmp_path / "a.zarr"
    result = call("capture", file, "--out", store, "--set", asked)
    (told,) = result.stderr.splitlines()
    assert result.exit_code == command.STOPPED and line in told and not store.exists()


PLUG_IN = recipe("a device")


def test_a_camera_of_another_package_is_told_of_and_works(tmp_path, monkeypatch):
    """Found by its entry point, in 'thincam doctor' and in a file of a real rig."""
    (tmp_path / "elsewhere.py").write_text(PLUG_IN, "utf-8")
    info = tmp_path / "elsewhere-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n", "utf-8"
    )
    points = "[thincam_jax.cameras]\neye = elsewhere:Eye\n"
    points += "[thincam_jax.displays]\nscreen = elsewhere:Screen\nbroken = nowhere_at_all:Screen\n"
    (info / "entry_points.txt").write_text(points, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    lines = driver_report()
    assert "driver of cameras eye, from elsewhere" in lines
    assert "driver of stages zaber" in lines
    (broken,) = (line for line in lines if "broken" in line)
    assert "its library is missing (No module named 'nowhere_at_all')" in broken
    (late,) = (line for line in lines if "aravis" in line)
    assert late.endswith("aravis") == (find_spec("gi") is not None)
    sets = ("--set", "rig=real", "--set", "camera.driver=eye", "--set", "display.driver=screen")
    file = tiny.write(tmp_path)
    called("capture", file, "--out", tmp_path / "a.zarr", *sets)
    taken = Acquisition.load(tmp_path / "a.zarr")
    assert taken.provenance["devices"]["camera"]["vendor"] == "Elsewhere"
    assert taken.frame(taken.lit[0]).max() > 100


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("class Eye(:", "SyntaxError: invalid syntax"),
        ("raise RuntimeError('no licence')", "RuntimeError: no licence"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("Other = 1", "AttributeError: module 'wreck' has no attribute 'Eye'"),
        ("Eye = 1", "TypeError: "),
        ("from thincam_jax.hardware import Camera\nclass Eye(Camera): pass", "AttributeError: "),
        (
            "from thincam_jax.hardware import Camera\nclass Eye(Camera):\n    Options = int",
            "TypeError: Eye is no device with Options",
        ),
    ],
)
def test_a_broken_camera_of_another_package_is_told_of(code, cause, tmp_path, monkeypatch):
    """In 'thincam doctor', which goes on, and in a line of a capture that wants it."""
    (tmp_path / "wreck.py").write_text(code, "utf-8")
    points = importlib.metadata.EntryPoint("eye", "wreck:Eye", "thincam_jax.cameras")
    found = {"thincam_jax.cameras": [points]}
    monkeypatch.setattr(registry, "entry_points", lambda group: found.get(group, []))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wreck", raising=False)
    lines = command.known_drivers()
    assert "driver of stages zaber" in lines
    (broken,) = (line for line in lines if " eye" in line)
    assert f"eye, from wreck: broken ({cause}" in broken and broken.endswith("remove wreck")
    sets = ("--set", "rig=real", "--set", "camera.driver=eye")
    result = call("capture", tiny.write(tmp_path), "--out", tmp_path / "a.zarr", *sets)
    (told,) = result.stderr.splitlines()
    assert result.exit_code == command.STOPPED and f"broken ({cause}" in told


def test_files_go_to_the_command_that_takes_them(tmp_path):
    assert "give it to 'thincam capture'" in one_line(call("run", tiny.write(tmp_path)))
    assert "a store that thincam capture has completed" in one_line(call("run", tmp_path))
