"""Comparisons of masks: what a file may say, what light is equal, what a run finds and says."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands.study.tiny import ignore

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.masks.build import Seen, best_linear, build_setup, capture
from thincam_jax.commands.masks.run import run_masks
from thincam_jax.commands.masks.words import Results
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.imaging.operators import CropConvolution, kernel_shape

TEXT = """\
name: tiny-masks
kind: masks
seed: 1
wavelength: 550 nm
band: [500 nm, 600 nm]
sensor: {shape: [48, 56], pitch: 24 um}
distance: 2 mm
field: [24, 28]
light: [1000, 100000]
object_distances: [300 mm, 20 mm]
masks:
  - {name: pinhole, mask: {family: pinhole, width: 48 um}}
  - {name: lenslets, mask: {family: lenslets, focal_length: 2 mm, cell: 248 um, lenses: [3, 3]}}
  - name: contours
    mask: {family: contours, width: 744 um, cell: 8 um, feature: 200 um, line_width: 24 um}
  - {name: MURA, mask: {family: mura, order: 31, cell: 24 um}}
  - {name: zone plate, beta: 100 rad/mm^2, mask: {family: fza, width: 744 um}}
  - name: four phases
    beta: 100 rad/mm^2
    mask: {family: fza, width: 744 um}
    synthesis: fringe_scanning
scenes:
  - {name: photograph, kind: photograph, image: camera}
  - {name: points, kind: point_grid, pixels: 28, prior: flat}
  - {name: astronaut, kind: photograph, image: astronaut}
tuning: {scene: astronaut, tau: [1, 4], iterations: 20}
notes:
  - A note <b>of its own</b>.
"""


def load(folder, *overrides):
    path = folder / "tiny.yaml"
    path.write_text(TEXT, encoding="utf-8")
    return load_experiment(path, overrides)


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("masks.4={name: a, mask: {width: 744 um}}", r"masks\[4\].beta: missing"),
        ("masks.0.beta=3 rad/mm^2", r"masks\[0\].beta: is of a zone plate"),
        ("masks.3.synthesis=fringe_scanning", r"masks\[3\].synthesis: only a zone plate"),
        ("masks.3.mask.order=29", r"masks\[3\].mask: is 0.696 mm wide and another 0.744"),
        ("masks.2.mask={family: contours, width: 1 mm, cell: 8 um}", "mask.feature: missing"),
        ("sensor.electrons=100", "sensor: light says how long"),
        ("light=[1000, 10]", "light: .* do not rise"),
        ("tuning.scene=moon", "tuning.scene: 'moon' is no scene; choose one of photograph,"),
    ],
)
def test_faults_are_told(tmp_path, override, complaint):
    with pytest.raises(ConfigError, match=complaint) as error:
        load(tmp_path, override)
    assert "\n" not in str(error.value)


def test_masks_and_scenes_that_cannot_be_made(tmp_path):
    config = load(tmp_path, "masks.3.mask={family: random, width: 744 um, cell: 25 um}")
    few = config.model_copy(update={"masks": (config.masks[0], config.masks[3])})
    with pytest.raises(ConfigError, match=r"^masks\[1\]: width = 0.744 mm is not"):
        build_setup(few)


def test_light_is_that_of_the_bare_sensor(tmp_path):
    """A white scene through a PSF of one over the field's shadow: the electrons asked for, and
    captures that share it have their parts."""
    config = load(tmp_path)
    few = (config.masks[0], config.masks[-1])
    setup = build_setup(config.model_copy(update={"masks": few}))
    whole = kernel_shape(config.sensor.shape, config.field)
    white = jnp.ones((1, *config.field))
    one, four = few
    seen = capture(setup, one, jnp.ones((1, *whole)), white, 1e4, jax.random.key(0))
    area = np.prod(config.field) * config.sensor.pitch**2
    electrons = np.asarray(seen.channels[0, 0]) / area * 1e4
    np.testing.assert_allclose(electrons.mean(), 1e4, rtol=1e-3)
    np.testing.assert_allclose(electrons.var(), 1e4 + 9, rtol=0.1)
    np.testing.assert_allclose(seen.variance * (1e4 / area) ** 2, 1e4 + 9, rtol=1e-3)
    # Differences of two of four captures, each of a quarter of the light.
    seen = capture(setup, four, jnp.ones((4, *whole)), white, 1e4, jax.random.key(0))
    expected = 2 * (2500 + 9) * (area / 2500) ** 2
    np.testing.assert_allclose(seen.variance, expected, rtol=1e-3)
    np.testing.assert_allclose(np.var(seen.channels), expected, rtol=0.1)
    np.testing.assert_allclose(seen.level, 1, rtol=0.01)  # which the differences do not tell


def test_linear_estimate_solves_its_equation(tmp_path, key):
    """Against the dense normal equations, of two cameras whose PSFs reach beyond the sensor."""
    shape, field = (9, 12), (7, 8)
    whole = kernel_shape(shape, field)
    kernels = jax.random.uniform(key, (2, *whole))
    cameras = [CropConvolution(h[None], 0.1, shape, field) for h in kernels]
    images = jax.random.uniform(key, (1, *field))
    channels = jnp.stack([camera(images[:, None])[:, 0] for camera in cameras], axis=1)
    variance, (a, b) = jnp.array([1e-3]), (3.0, 0.2)
    found = best_linear(cameras, Seen(channels, variance, jnp.array([0.4])), jnp.array([[a, b]]))
    units = jnp.eye(56).reshape(56, 1, *field)
    matrix = np.concatenate([np.asarray(c(units)).reshape(56, -1).T for c in cameras])
    basis = np.eye(56).reshape(56, *field)
    rough = np.concatenate([np.diff(basis, axis=n).reshape(56, -1).T for n in (1, 2)])
    uniform, g = matrix.sum(axis=1), np.asarray(channels).reshape(2, -1).ravel()
    normal = matrix.T @ matrix / 1e-3 + a * rough.T @ rough + b * np.eye(56)
    expected = np.linalg.solve(normal, matrix.T @ (g - 0.4 * uniform) / 1e-3) + 0.4
    np.testing.assert_allclose(found.ravel(), expected, atol=0.01)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("masks")
    config = load(home)
    folder = RunFolder(home / "out")
    metrics = run_masks(build_setup(config), folder, ignore)
    return Results(metrics, config), folder.path


@pytest.mark.thorough
def test_scores_keep_the_order_of_the_masks(run):
    results, _ = run
    weak, strong = results.config.light
    for method in ("linear", "total variation"):
        best = [results.score(m, "photograph", strong, method=method) for m in results.masks]
        lenslets, contours, code = (best[n] for n in (1, 2, 3))
        assert lenslets > contours > code
    for mask in results.masks:
        for scene in results.scenes:
            assert results.score(mask, scene, strong) > results.score(mask, scene, weak) - 0.1
    # Beside read noise, a pinhole's light is nothing.
    gaps = [
        results.score("pinhole", "photograph", light, method="linear")
        - results.score("MURA", "photograph", light, method="linear")
        for light in (weak, strong)
    ]
    assert gaps[0] < gaps[1]


@pytest.mark.thorough
def test_what_the_psf_says(run):
    results, _ = run
    masks = results.masks
    assert masks["pinhole"]["throughput"] == pytest.approx((48 / 744) ** 2, rel=0.05)
    assert masks["MURA"]["throughput"] == pytest.approx(0.5, rel=0.02)
    assert masks["lenslets"]["throughput"] == pytest.approx(1.0, rel=0.03)
    assert masks["lenslets"]["detail"] == pytest.approx(1 / 3, rel=0.3)  # of nine equal points
    assert masks["four phases"]["captures"] == 4
    for mask in masks.values():
        assert 0 <= mask["weakest"] < mask["flatness"] <= 1
        assert set(mask["tau"].values()) <= {1, 4}
    assert results.unfocused("MURA") > 0 and results.near("zone plate") < results.near("lenslets")


@pytest.mark.thorough
def test_files(run):
    results, path = run
    stored = json.loads((path / "metrics.json").read_text("utf-8"))
    # Masks × scenes × lights × distances × colours × methods, and the wrong focus.
    assert len(stored["cases"]) == 6 * 2 * (2 * 2 * 2 * 2 + 1)
    assert len(stored["findings"]) == 12
    page = (path / "report.html").read_text("utf-8")
    assert page.count("data:image/png") == 2 and "A note &lt;b&gt;" in page
    assert not re.search(r"\b(nan|None)\b", page)
