"""The explorer: what it shows is what the functions of the package compute."""

import io
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
from jax import monitoring

import thincam_jax as tc
from thincam_jax.plot.explorer import Explorer
from thincam_jax.units import nm, um

SENSOR = tc.Sensor((96, 256), 22 * um)
CAMERA = tc.LenslessCamera(tc.FresnelZoneAperture(25.0, width=5.632), SENSOR, distance=5.0)


def picture(content):
    return np.asarray(PIL.Image.open(io.BytesIO(content)), float)


@pytest.fixture(scope="module")
def explorer():
    return Explorer(CAMERA, wavelength=500 * nm)


@pytest.mark.thorough
def test_the_psf_is_that_of_the_camera_as_it_is_set(explorer):
    explorer.turn({"beta": 17.0, "distance": 6.0, "wavelength": 600.0, "object_distance": 90.0})
    assert explorer.light == {"wavelength": pytest.approx(600 * nm), "object_distance": 90.0}
    assert float(explorer.camera.mask.beta) == 17.0 and float(explorer.camera.distance) == 6.0
    h = np.asarray(tc.psf(explorer.camera, pixel_integration=True, **explorer.light))
    exact = 255 * h / h.max()
    moving = explorer.view(rest=False)
    assert [*moving.pictures] == ["psf"] and not moving.lines
    error = picture(moving.pictures["psf"]) - exact
    assert np.sqrt(np.mean(error**2)) < 6  # of a JPEG
    response = np.abs(np.asarray(tc.otf(explorer.camera, pixel_integration=True, **explorer.light)))
    along = response[48, 129:]
    assert moving.step == pytest.approx(1 / (256 * 22 * um))
    np.testing.assert_allclose(moving.transfer / moving.transfer[0], along / along[0], rtol=2e-4)


@pytest.mark.thorough
def test_at_rest_come_capture_image_and_model(explorer):
    explorer.turn({control.name: control.value for control in explorer.controls})
    view = explorer.view()
    h = np.asarray(tc.psf(explorer.camera, pixel_integration=True, **explorer.light))
    np.testing.assert_allclose(picture(view.pictures["psf"]), 255 * h / h.max(), atol=1.01)
    assert [*view.pictures] == ["psf", "capture", "image"]
    assert picture(view.pictures["capture"]).shape == (96, 256)
    side, columns = picture(view.pictures["image"]).shape
    assert side == columns and abs(side - 0.7 * 96) < 1.5  # a square scene
    captures, model = view.lines
    assert captures.startswith("Four captures of 96×256 pixels at 30 dB, fringe scanning: ")
    assert float(captures.split()[-2]) > 15
    assert model.startswith("A PSF within 1 %: model ")
    # cos(πλdMu²) = 0: Eq 3.32 of the thesis with the magnification of a near object.
    expected = 1 / np.sqrt(2 * 500 * nm * 5.0 * (1 + 5.0 / 250.0))
    assert view.zero == pytest.approx(expected, rel=0.05)
    header, pictures = view.message()
    assert json.loads(header)["names"] == [*view.pictures] and len(pictures) == 3


@pytest.mark.parametrize("moves", [20, pytest.param(200, marks=pytest.mark.thorough)])
def test_moving_compiles_nothing(explorer, moves):
    """Each control in turn, with the programs of JAX counted."""
    compiled = []
    monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    explorer.turn({"beta": 9.0})
    explorer.view(rest=False)
    before, controls = len(compiled), explorer.controls
    for move in range(moves):
        one, part = controls[move % len(controls)], (move + 0.5) / moves
        explorer.turn({one.name: one.low + part * (one.high - one.low)})
        explorer.view(rest=False)
    assert len(compiled) == before and explorer._moving._cache_size() == 1
    jax.jit(lambda x: x + before)(0.0)
    assert len(compiled) > before  # they are counted


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"gamma": 1.0}, "control = 'gamma' is unknown; choose one of 'beta'"),
        ({"beta": 1e9}, r"beta = 1000000000.0 rad/mm² is out of range; give 6.25 to 62.5"),
    ],
)
def test_what_cannot_be_turned(values, line, explorer):
    before = dict(explorer.values)
    with pytest.raises((ValueError, TypeError), match=line):
        explorer.turn(values)
    assert explorer.values == before


@pytest.mark.thorough
def test_off_the_axis_the_psf_is_that_of_the_point(explorer):
    explorer.turn({control.name: control.value for control in explorer.controls})
    explorer.turn({"angle": 12.0, "tolerance": 10.0})
    assert explorer.at == (0.0, pytest.approx(250.0 * np.tan(np.radians(12.0))))
    view = explorer.view()
    # The mask moved so that the ray meets the middle of the sensor.
    tangent = np.tan(np.radians(12.0))
    mask = tc.FresnelZoneAperture(25.0, width=5.632, centre=(0.0, 5.0 * tangent))
    light = explorer.light | {"at": (0.0, 255.0 * tangent)}
    moved = tc.LenslessCamera(mask, SENSOR, distance=5.0)
    h = np.asarray(tc.psf(moved, pixel_integration=True, **light))
    np.testing.assert_allclose(picture(view.pictures["psf"]), 255 * h / h.max(), atol=1.01)
    _, model, angle = view.lines
    assert model.startswith("A PSF within 10 %: model ")
    predicted, found = (float(n) for n in re.findall(r"[\d.]*\d(?:e-\d+)?", model)[1:])
    assert 1e-3 < found < predicted < 0.1
    assert "are about the ray at 12°, 0.0" in angle


def test_the_widget_answers_what_its_module_asks(monkeypatch):
    pytest.importorskip("anywidget")
    widget = tc.explore(CAMERA, wavelength=500 * nm)
    assert [control["name"] for control in widget.controls][:2] == ["beta", "phase"]
    sent = []
    monkeypatch.setattr(widget, "send", lambda content, buffers: sent.append((content, buffers)))
    asked = {"id": 7, "values": {"beta": 15.0}, "rest": False}
    widget._handle_custom_msg(asked, [])
    ((content, buffers),) = sent
    assert content["id"] == 7 and json.loads(content["header"])["values"]["beta"] == 15.0
    assert picture(buffers[0]).shape == (96, 256)
    assert float(widget.camera.mask.beta) == 15.0 and set(widget.light) == {
        "wavelength",
        "object_distance",
    }


def test_scenes_and_sensors_that_cannot_be_explored():
    with pytest.raises(ValueError, match=r"scene has shape \(3, 20, 20\); give one image"):
        Explorer(CAMERA, jnp.ones((3, 20, 20)))
    large = tc.LenslessCamera(CAMERA.mask, tc.Sensor((64, 4096), 5 * um), distance=5.0)
    with pytest.raises(ValueError, match="give one of at most 2048 a side"):
        Explorer(large)
