"""Screen experiments: what a file may say, what a run finds and leaves behind."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from commands.study.tiny import Told
from PIL import Image
from waveguide.commands import tiny

from helpers import ROOT
from thincam_jax import waveguide as wg
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.waveguide.commands.run import build_cameras, build_screen, run_screen
from thincam_jax.waveguide.rays import RayStatus


def stored(path):
    return json.loads((path / "metrics.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("screen")
    study, texts = build_screen(tiny.experiment(home)), Told()
    folder = RunFolder(home / "out")
    run_screen(study, folder, texts)
    return study, folder.path, stored(folder.path), texts


PICTURES = ("rays", "field", "images", "models", "errors", "columns", "distances")


LIT = (
    "calibration=null",
    "display_light.leak=[[400 nm, 0.1], [700 nm, 0.1]]",
    "display_light.primaries=[{centre: 530 nm, width: 60 nm}]",
    "noise={read_noise: 2}",
    "sensor={shape: [22, 30], pitch: 70.4 um, full_well: 20000, exposure: 0.7}",
)


def test_the_light_of_a_display_in_a_file(tmp_path):
    pattern = np.ones((22, 30), np.float32)
    pattern[:11] = 3
    tifffile.imwrite(tmp_path / "light.tif", pattern)
    more = ("display_frames=3", "display_light.path=light.tif")
    lit = build_screen(tiny.experiment(tmp_path, *LIT, *more))
    assert lit.display_light is not None and lit.display_frames == 3
    np.testing.assert_allclose(lit.display_light.leak, [[400e-6, 0.1], [700e-6, 0.1]])
    np.testing.assert_allclose(
        np.asarray(lit.background)[[0, -1], 0] / lit.background.mean(), [1.5, 0.5], 1e-5
    )


@pytest.mark.thorough
def test_a_page_says_the_light_of_a_display(tmp_path):
    given = (*LIT, "models=[{name: right}]", "methods=[{name: CGM, kind: ridge}]")
    run_screen(build_screen(tiny.experiment(tmp_path, *given)), RunFolder(tmp_path / "out"), Told())
    light = stored(tmp_path / "out")["display_light"]
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert light > 0.5 and f"adds {light:.3g} of a white object" in page
    assert "exposures of it, subtracted: 1." in page


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("calibration={bits: 10}", "display_light: is of captures without a calibration; drop one"),
        ("noise={snr_db: 40}", "noise.read_noise: light of a display has shot noise; give"),
        ("display_light.leak=[[700 nm, 0.1], [400 nm, 0.1]]", "wavelengths that do not rise; sort"),
        ("display_light.path=lost.tif", "display_light.path: .*lost.tif"),
    ],
)
def test_a_display_that_does_not_fit_is_told(asked, line, tmp_path):
    with pytest.raises(ConfigError, match=line):
        build_screen(tiny.experiment(tmp_path, *LIT, asked))


@pytest.mark.thorough
def test_a_file_of_a_full_colour_hologram(tmp_path):
    overrides = (
        "hologram.wavelength=null",
        "hologram.colours=[630 nm, 532 nm, 460 nm]",
        "models=[{name: right}]",
        "methods=[{name: CGM, kind: ridge}]",
        "targets=[{name: face, kind: photograph, image: astronaut}]",
    )
    with pytest.raises(ConfigError, match="calibration.distances: need a hologram of one colour"):
        tiny.experiment(tmp_path, *overrides)
    study = build_screen(tiny.experiment(tmp_path, *overrides, "calibration=null"))
    np.testing.assert_allclose(study.wavelengths[0] / study.wavelengths[1], 630 / 532, rtol=1e-6)
    assert len(study.cameras) == 3 and study.targets["face"].shape == (8, 16, 3)
    run_screen(study, RunFolder(tmp_path / "out"), Told())
    pictures = [np.asarray(Image.open(path)) for path in (tmp_path / "out/images").iterdir()]
    assert pictures and all(picture.shape == (8, 16, 3) for picture in pictures)
    assert all(np.ptp(picture.astype(int), axis=-1).max() > 20 for picture in pictures)
    score = stored(tmp_path / "out")["models"]["right"]["methods"]["CGM"]["mean_psnr_db"]
    assert score > 20


RESPONSES = "hologram.responses=[{}]".format(
    ", ".join(f"{{centre: {centre} nm, width: 80 nm}}" for centre in (610, 535, 465))
)


def test_a_file_of_a_colour_sensor(tmp_path):
    with pytest.raises(ConfigError, match="hologram.responses: are to three colours; give colours"):
        tiny.experiment(tmp_path, RESPONSES)
    colours = "hologram.wavelength=null", "hologram.colours=[633 nm, 532 nm, 473 nm]"
    face = "targets=[{name: face, kind: photograph, image: astronaut}]"
    config = tiny.experiment(tmp_path, *colours, RESPONSES, face, "calibration.distances=[]")
    study = build_screen(config)
    assert study.responses[1].centre == pytest.approx(535e-6) and len(study.responses) == 3


@pytest.mark.thorough
def test_progress_and_files(run):
    study, path, _, texts = run
    assert len(texts) == texts.total == 1 + 3 * 2 + (1 + 2 + 1 + 1) + 1
    names = {p.name for p in (path / "figures").iterdir()}
    assert names == {f"{n}.png" for n in PICTURES}
    assert len(list((path / "images").iterdir())) == 2 * 2
    assert not list(path.glob("*.zarr"))  # keep_captures
    assert tiny.experiment(path, text=(path / "config.yaml").read_text("utf-8")) == study.config


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("hologram.wavelength=null", "hologram.wavelength: give it, such as 532 nm, or three"),
        ("methods.0.variation.tau=2", "methods[0].variation: kind ridge does not take it"),
        (
            "targets.0.published={FISTA: {psnr_db: 3, seconds: 1}}",
            "targets[0].published.FISTA: 'FISTA' is no method; choose one of CGM, smooth",
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


def test_the_shipped_file(tmp_path):
    shipped = tiny.experiment(tmp_path, text=(ROOT / "configs/sts_camera.yaml").read_text("utf-8"))
    assert tiny.experiment(tmp_path, text=dump_config(shipped)) == shipped
    assert shipped.sensor.shape == (440, 440)
    assert {model.mistake for model in shipped.models} >= {"grating", "ghost_index"}
    (camera,) = build_cameras(shipped)
    status = wg.trace(camera, jnp.zeros(2), object_distance=550.0, orders=4).status
    assert status.tolist() == [0, 0, 0, RayStatus.OFF_HOLOGRAM]  # of the thesis' size


MASK = "mask: {beta: 6 rad/mm^2, width: 1.4 mm, distance: 6.5 mm, gap: 0.5 mm, points: 3}"
WITH_MASK = re.sub(r"calibration:.*?(?=targets:)", "", tiny.TEXT, flags=re.DOTALL)
for _lens, _mask in (
    ("lens: {focal_distance: 6 mm, lens_distance: 10 mm}", MASK),
    ("{shape: [22, 30], pitch: 70.4 um}", "{shape: [24, 32], pitch: 130 um}"),
    ("distance: 550 mm, width: 120 mm, y: 27 mm", "distance: 550 mm, width: 150 mm, y: 9 mm"),
    ("band_samples: 3\n", ""),
):
    assert _lens in WITH_MASK
    WITH_MASK = WITH_MASK.replace(_lens, _mask)


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("lens={focal_distance: 6 mm, lens_distance: 10 mm}", "mask: give a lens, or a mask in"),
        ("mask=null", "mask: give a lens, or a mask in its place"),
        ("calibration={bits: 10}", "calibration: measures a camera with a lens; drop it"),
        ("screen.tilt=[1 deg, 0 deg]", "screen.tilt: a mask is parallel to the plate; drop"),
        ("models.1.mistake=grating", "models[1].mistake: 'grating' is of a camera with a lens; ch"),
        ("mask.points=4", "mask.points: points = 4 is even; give 5"),
    ],
)
def test_what_does_not_hold_behind_a_mask_is_refused_in_one_line(override, part, tmp_path):
    with pytest.raises(ConfigError) as caught:
        tiny.experiment(tmp_path, override, text=WITH_MASK)
    (line,) = str(caught.value).split("\n")
    assert part in line


@pytest.mark.thorough
def test_a_file_with_a_mask_in_place_of_the_lens(tmp_path):
    """The right model is the best one, and the page says what stands before the sensor."""
    smooth = "{name: CGM, kind: admm_tv, variation: {tau: 0.1, iterations: 60}}"
    config = tiny.experiment(tmp_path, f"methods=[{smooth}]", text=WITH_MASK)
    assert tiny.experiment(tmp_path, text=dump_config(config)) == config
    result = run_screen(build_screen(config), RunFolder(tmp_path / "out"), Told())
    means = {
        name: model.methods["CGM"].scores.mean_psnr_db or 0.0
        for name, model in result.models.items()
    }
    assert means["right"] > 19 and means["right"] > means["convolution"]
    assert means["right"] > means["single"] + 5
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "1.4 mm (cosine), 6.5 mm before it" in page and "s shadow, once for each order" in page
    assert {p.stem for p in (tmp_path / "out/figures").iterdir()} == set(PICTURES[:5])
    assert stored(tmp_path / "out")["entries_of_the_system"] == 24 * 32 * 8 * 16


def test_a_camera_that_sees_nothing_is_refused(tmp_path):
    config = tiny.experiment(tmp_path, "screen.bottom.y=900 mm")
    with pytest.raises(ConfigError, match=r"tiny.yaml:\d+: screen: no ray .* off hologram"):
        build_screen(config)


def test_cells_that_are_no_power_of_two_are_told_with_their_line(tmp_path):
    text = tiny.TEXT.replace("[8, 16]", "[12, 16]")
    told = r"tiny.yaml:\d+: object.cells: 12 × 16 = 192 cells are no power of two, as Hadamard"
    with pytest.raises(ConfigError, match=told) as caught:
        tiny.experiment(tmp_path, text=text)
    assert str(caught.value).count("\n") == 0
    tiny.experiment(tmp_path, "calibration=null", text=text)
