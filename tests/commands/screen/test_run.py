"""Screen experiments: what a file may say, what a run finds and leaves behind."""

import json
import re

import numpy as np
import pytest
from commands.screen import tiny
from commands.study.tiny import Told

from helpers import ROOT
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.screen.build import build_setup, mistaken_rays
from thincam_jax.commands.screen.figures import srgb
from thincam_jax.commands.screen.run import run_screen
from thincam_jax.imaging.targets import load_image
from thincam_jax.units import nm


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("screen")
    setup, texts = build_setup(tiny.experiment(home)), Told()
    folder = RunFolder(home / "out")
    metrics = run_screen(setup, folder, texts)
    return setup, folder.path, metrics, texts


PICTURES = ("rays", "field", "images", "models", "errors", "columns", "distances")


@pytest.mark.thorough
def test_the_right_model_is_the_best(run):
    models = run[2]["models"]
    means = {
        name: [method["mean_psnr_db"] for method in model["methods"].values()]
        for name, model in models.items()
    }
    for name in ("convolution", "single"):
        assert (np.array(means["right"]) > np.array(means[name]) + 1.5).all()
    assert min(means["right"]) > 25


def test_without_a_calibration_there_is_a_report(tmp_path):
    """Its page does not speak of one, and neither do the tables. Without its ghosts it is worse."""
    models = "models=[{name: right}, {name: single, mistake: no_ghosts}]"
    config = tiny.experiment(tmp_path, "calibration=null", models)
    metrics = run_screen(build_setup(config), RunFolder(tmp_path / "out"), Told())
    right, single = (
        metrics["models"][name]["methods"]["CGM"]["mean_psnr_db"] for name in ("right", "single")
    )
    assert right > 25 and right > single + 1.5
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "calibration" not in metrics and "Hadamard" not in page


@pytest.mark.thorough
def test_a_tilted_plate_is_found(tmp_path):
    """From a straight one, by the calibration; and the file's angle is the camera's."""
    fitted = ("calibration.fitted=[plate_x, plate_y]", "calibration.glass_thickness=null")
    config = tiny.experiment(
        tmp_path, "screen.tilt=[0.4 deg, -0.2 deg]", *fitted, "calibration.distances=[]"
    )
    setup = build_setup(config)
    tilt = np.deg2rad([0.4, -0.2])
    np.testing.assert_allclose(setup.camera.tilt, tilt)
    values = run_screen(setup, RunFolder(tmp_path / "out"), Told())["calibration"]["fit"]["values"]
    for name, true in zip(("plate_x", "plate_y"), tilt, strict=True):
        assert values[name]["true"] == pytest.approx(true)
        assert values[name]["found"] == pytest.approx(true, abs=2e-4)


@pytest.mark.thorough
def test_a_full_colour_hologram_gives_a_colour_picture(tmp_path):
    """Each channel by its own hologram, and without ghosts it is worse."""
    overrides = (
        "hologram.wavelength=null",
        "hologram.colours=[630 nm, 532 nm, 460 nm]",
        "models=[{name: right}, {name: single, mistake: no_ghosts}]",
        "methods=[{name: CGM, kind: ridge}]",
        "targets=[{name: face, kind: photograph, image: astronaut}]",
    )
    with pytest.raises(ConfigError, match="calibration: takes a hologram of one colour"):
        tiny.experiment(tmp_path, *overrides)
    setup = build_setup(tiny.experiment(tmp_path, *overrides, "calibration=null"))
    light = setup.wavelengths
    np.testing.assert_allclose(light[0] / light[1], 630 / 532, rtol=1e-12)
    metrics = run_screen(setup, RunFolder(tmp_path / "out"), Told())
    right, single = (
        metrics["models"][name]["methods"]["CGM"]["mean_psnr_db"] for name in ("right", "single")
    )
    assert right > 25 and right > single + 3
    image = load_image(tmp_path / "out" / "images" / "face--cgm.png")
    assert image.shape == (8, 16, 3) and np.ptp(image, axis=-1).max() > 0.1


@pytest.mark.thorough
def test_total_variation_through_the_matrix(tmp_path):
    """The measured matrix serves ADMM as the exact rays do, at another distance too."""
    methods = "methods=[{name: TV, kind: admm_tv, variation: {tau: 0.5, iterations: 30}}]"
    config = tiny.experiment(tmp_path, methods, "targets.0.published={}")
    metrics = run_screen(build_setup(config), RunFolder(tmp_path / "out"), Told())
    right, measured = (
        metrics["models"][name]["methods"]["TV"]["mean_psnr_db"]
        for name in ("right", "measured matrix")
    )
    assert measured == pytest.approx(right, abs=0.5) and right > 30
    means = metrics["calibration"]["distances"]["450 mm"]
    assert means["from the fit"]["mean_psnr_db"] > means["measured there"]["mean_psnr_db"] - 1


@pytest.mark.thorough
def test_rays_are_those_of_the_plate(run):
    rays = run[2]["rays"]
    low, high = rays["wavelength_nm"]
    assert 480 < low < 532 < high < 575
    assert rays["guided_angle_deg"][0] > 41.8
    assert rays["first_ghost_down_mm"][0] < 18.19 < rays["first_ghost_down_mm"][1]
    assert sum(rays["status_percent"].values()) == pytest.approx(100, abs=0.1)
    assert rays["status_percent"]["off_hologram"] > 0


@pytest.mark.thorough
def test_a_calibration_is_as_good_as_its_noise(run):
    """The matrix has the noise of its frames, and takes the place of the exact rays."""
    setup, path, metrics, _ = run
    found = metrics["calibration"]
    assert found["frames"] == 2 * 8 * 16
    spread = (2 * (1 + 1 / 12) / 128) ** 0.5
    assert found["expected_noise_counts"] == pytest.approx(spread, abs=1e-5)
    assert found["noise_counts"] == pytest.approx(spread, rel=0.1)
    measured, right = (
        [method["mean_psnr_db"] for method in metrics["models"][name]["methods"].values()]
        for name in ("measured matrix", "right")
    )
    assert np.array(measured) == pytest.approx(np.array(right), abs=1)
    assert not list(path.glob("*.zarr"))  # keep_captures


@pytest.mark.thorough
def test_another_distance_follows_from_the_fit(run):
    found = run[2]["calibration"]
    glass = found["fit"]["values"]["glass_thickness"]
    assert glass["true"] == 5 and glass["unit"] == "mm"
    assert glass["found"] == pytest.approx(5, abs=0.05)  # from 5.3 mm
    means = {name: way["mean_psnr_db"] for name, way in found["distances"]["450 mm"].items()}
    assert abs(means["from the fit"] - means["measured there"]) < 1
    assert means["from the fit"] > means["as assumed"] + 1


@pytest.mark.thorough
def test_progress_and_files(run):
    setup, path, metrics, texts = run
    assert len(texts) == texts.total == 1 + 3 * 2 + (1 + 2 + 1 + 1) + 1
    assert json.loads((path / "metrics.json").read_text("utf-8")) == metrics
    names = {p.name for p in (path / "figures").iterdir()}
    assert names == {f"{n}.png" for n in PICTURES}
    assert len(list((path / "images").iterdir())) == 2 * 2
    assert tiny.experiment(path, text=(path / "config.yaml").read_text("utf-8")) == setup.config


@pytest.mark.thorough
def test_report_stands_alone_and_is_escaped(run):
    page = (run[1] / "report.html").read_text("utf-8")
    sources = re.findall(r'src="([^"]+)"', page)
    assert len(sources) == len(PICTURES)
    assert all(source.startswith("data:image/") for source in sources)
    assert "&lt;b&gt;of its own&lt;/b&gt;" in page
    assert ">16.8</td>" in page  # published


@pytest.fixture(scope="module")
def right(run):
    return mistaken_rays(run[0], run[0].camera, "none")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("mistake", "on_axis"),
    [
        ("none", 0.0),
        ("shift_invariant", 0.0),
        ("grating", 0.0),
        ("ghost_index", -18.19),
        ("no_smear", 0.0),
    ],
)
def test_mistakes_are_those_of_the_thesis(run, right, mistake, on_axis):
    """All but the ghost index agree on the axis, and none elsewhere."""
    setup = run[0]
    wrong = mistaken_rays(setup, setup.camera, mistake)
    moved = np.mean(wrong.points - right.points, axis=-2)[..., 1]
    rows, columns = setup.camera.sensor.shape
    middle = moved[:, rows // 2 - 1 : rows // 2 + 1, columns // 2 - 1 : columns // 2 + 1].mean(
        (1, 2)
    )
    np.testing.assert_allclose(middle, on_axis, atol=0.05)
    assert (np.ptp(moved[0]) > 1) == (mistake not in ("none", "no_smear"))


def test_colours_of_wavelengths():
    red, green, blue = srgb(np.array([630.0, 530.0, 455.0]) * nm)
    assert red.argmax() == 0 and green.argmax() == 1 and blue.argmax() == 2
    assert red.max() == green.max() == blue.max() == 1


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("hologram.wavelength=532", "hologram.wavelength: "),
        ("hologram.wavelength=null", "hologram.wavelength: give it, such as 532 nm, or three"),
        ("models.1.mistake=all", "models[1].mistake: 'all' is unknown; choose one of"),
        ("methods.0.variation.tau=2", "methods[0].variation: kind ridge does not take it"),
        (
            "targets.0.published={FISTA: {psnr_db: 3, seconds: 1}}",
            "targets[0].published.FISTA: 'FISTA' is no method; choose one of CGM, smooth",
        ),
        ("noise.snr_db=loud", "noise.snr_db: "),
        (
            "calibration={fitted: [glass]}",
            "calibration.fitted[0]: 'glass' is unknown; choose from glass_thickness, ",
        ),
        ("calibration.fitted=[tilt, tilt]", "calibration.fitted: names one number twice"),
        ("calibration.offset=512", "calibration.offset: 512 fills half of the 10 bits"),
        (
            "calibration.display=binary",
            "calibration.display: a binary display with an offset needs dark frames",
        ),
        ("models.1.name=measured matrix", "models[1].name: 'measured matrix' is the name of the"),
    ],
)
def test_faults_are_told_in_one_line_with_their_place(override, part, tmp_path):
    with pytest.raises(ConfigError) as caught:
        tiny.experiment(tmp_path, override)
    line = str(caught.value).split("\n")[0]
    assert line.startswith("--set ")
    assert part in line


def test_a_fault_in_the_file_is_told_with_its_line(tmp_path):
    with pytest.raises(ConfigError, match=r"tiny.yaml:6: hologram.reference_angle: "):
        tiny.experiment(tmp_path, text=tiny.TEXT.replace("61.2 deg", "91 deg"))


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("hologram.reference_angle=40 deg", "under the critical angle of 41.81°"),
        ("screen.glass_index=1.3", "a glass of n = 1.3 cannot carry"),
        (
            "screen.bottom.height=12 mm",
            r"smaller than one bounce of the guided light, \(0, 18.19\)",
        ),
    ],
)
def test_a_plate_that_guides_no_light_is_refused(override, part, tmp_path):
    config = tiny.experiment(tmp_path, override)
    with pytest.raises(ConfigError, match=rf"tiny.yaml:\d+: screen: .*{part}"):
        build_setup(config)


def test_cells_that_are_no_power_of_two_are_told_with_their_line(tmp_path):
    text = tiny.TEXT.replace("[8, 16]", "[12, 16]")
    told = r"tiny.yaml:\d+: object.cells: 12 × 16 = 192 cells are no power of two, as Hadamard"
    with pytest.raises(ConfigError, match=told) as caught:
        tiny.experiment(tmp_path, text=text)
    assert str(caught.value).count("\n") == 0
    tiny.experiment(tmp_path, "calibration=null", text=text)


def test_a_camera_that_sees_nothing_is_refused(tmp_path):
    config = tiny.experiment(tmp_path, "screen.bottom.y=900 mm")
    with pytest.raises(ConfigError, match=r"tiny.yaml:\d+: screen: no ray .* off hologram"):
        build_setup(config)


def test_the_shipped_calibration(tmp_path):
    text = (ROOT / "configs/sts_calibration.yaml").read_text("utf-8")
    shipped = tiny.experiment(tmp_path, text=text)
    assert tiny.experiment(tmp_path, text=dump_config(shipped)) == shipped
    full = ("object.cells=[64, 64]", "sensor.shape=[440, 440]", "sensor.pitch=4.8 um")
    assert all(f'{name}="{value}"' in text for name, value in (s.split("=") for s in full))
    assert tiny.experiment(tmp_path, *full, text=text).sensor.shape == (440, 440)
    assert shipped.calibration is not None and shipped.calibration.distances == (400, 900)


def test_the_shipped_file(tmp_path):
    shipped = tiny.experiment(tmp_path, text=(ROOT / "configs/sts_camera.yaml").read_text("utf-8"))
    assert tiny.experiment(tmp_path, text=dump_config(shipped)) == shipped
    assert shipped.sensor.shape == (440, 440)
    assert {model.mistake for model in shipped.models} >= {"grating", "ghost_index"}
