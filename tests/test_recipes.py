"""The recipes of CONTRIBUTING.md, followed; that of a device in tests/hardware/commands."""

import re
import sys
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from commands.test_cli import call, called, one_line

import thincam_jax as tc
from helpers import finite_difference, recipe, relative_l2
from thincam_jax.commands.kinds import KINDS
from thincam_jax.units import nm, um

LIGHT = {"wavelength": 550 * nm, "pixel_integration": True}


def followed(name):
    """What the code of a recipe defines."""
    defined = {"__name__": name}
    exec(recipe(name), defined)
    return defined


CONTRAST = """
name: seen
kind: contrast
wavelength: 500 nm
mask: {beta: 100 rad/mm^2, width: 0.7 mm}
distance: 5 mm
sensor: {shape: [24, 40], pitch: 22 um}
object: {distance: 250 mm, width: 40 mm}
targets: [{name: chart, kind: usaf1951, pixels: 32}, {name: star, kind: siemens_star, pixels: 32}]
"""


def test_a_kind_of_experiment_is_run_explained_and_checked(tmp_path, monkeypatch):
    module = ModuleType("thincam_jax.commands.contrast")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(KINDS, "contrast", None)
    exec(recipe("a kind of experiment file"), module.__dict__)
    path, out = tmp_path / "seen.yaml", tmp_path / "out"
    path.write_text(CONTRAST, "utf-8")
    shown = called("run", path, "--out", out)
    assert re.search(r"chart\W+0\.\d{3}\W+star\W+0\.\d{3}", shown.stdout)
    assert (out / "report.html").exists() and (out / "metrics.json").exists()
    said = call("explain", path).stdout
    assert "mask.width: 0.7 mm" in said and "2 captures of (24, 40) pixels" in said
    assert '"contrast"' in call("schema", "contrast").stdout
    path.write_text(CONTRAST.replace("distance: 5 mm", "distance: 5"), "utf-8")
    assert one_line(call("run", path)).startswith(f"{path}:6: distance: 5 has no unit")


def double_slit(width):
    mask = followed("a mask")["DoubleSlit"](width=width, spacing=60 * um, height=90 * um)
    return tc.LenslessCamera(mask, tc.Sensor((24, 40), 6 * um), 2.0)


def test_a_mask_has_its_exact_psf_and_gradients():
    camera = double_slit(24 * um)
    exact = tc.psf(camera, **LIGHT)
    methods = [tc.PsfMethod("angular_spectrum", oversampling=n) for n in (3, 9)]
    errors = [relative_l2(tc.psf(camera, model=method, **LIGHT), exact) for method in methods]
    assert errors[1] < 0.01 and errors[1] < errors[0] / 2

    def brightness(width):
        return tc.psf(double_slit(width), **LIGHT)[12, 20]

    slope, one = jax.grad(brightness)(0.024), jnp.ones(())
    assert np.isclose(
        slope, finite_difference(brightness, jnp.asarray(0.024), one, 1e-5), rtol=1e-5
    )


def test_a_solver_finds_what_a_matrix_gives(key):
    """One capture that the sensor crops, of a field of 9×13 pixels; the matrix is SciPy's."""
    psf = np.array([[0.0, 0.2, 0.0], [0.1, 0.4, 0.1], [0.0, 0.1, 0.1]])
    capture = np.asarray(jax.random.uniform(key, (5, 7)))
    psfs = tc.Psfs(np.pad(psf, ((1, 1), (2, 2)))[None])
    recording = tc.Recording(capture[None, None], psfs, noise_variance=1.0, background=0.0)
    found = tc.reconstruct(recording, followed("a solver")["LeastSquares"](strength=0.01))
    pixels = np.eye(9 * 13).reshape(-1, 9, 13)
    seen = [scipy.signal.convolve2d(pixel, psf, "same")[2:-2, 3:-3].ravel() for pixel in pixels]
    matrix = np.stack(seen, axis=1)
    normal = matrix.T @ matrix + 0.01 * np.eye(9 * 13)
    image = np.linalg.solve(normal, matrix.T @ capture.ravel()).reshape(9, 13)
    np.testing.assert_allclose(found.image[0], image[2:-2, 3:-3], rtol=1e-6)
    assert (found.method, found.status) == ("least_squares", "converged")
