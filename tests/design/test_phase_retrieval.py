"""Contours as asked for, and phases that send the light there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design.phase_mask import contour_mask
from thincam_jax.design.phase_retrieval import contour_target, match_error, retrieve_phase
from thincam_jax.lensless import LightPath, masks
from thincam_jax.lensless.masks.phase import MaskBlank
from thincam_jax.units import nm, um

GRID = tc.Grid((64, 80), 4 * um)
PATH = LightPath(532 * nm, 2.0)


def test_contours_are_thin_lines_in_all_directions(key):
    target = np.asarray(contour_target(key, GRID, feature=80 * um, line_width=8 * um))
    np.testing.assert_allclose(target.sum(), 1, rtol=1e-6)
    lit = target > 0.5 * target.max()
    assert 0.05 < lit.mean() < 0.35
    # A line of two samples' width: nothing is left of it three samples in.
    thick = lit[:-4, :-4]
    for i, j in ((4, 0), (0, 4), (4, 4), (2, 2)):
        thick = thick & lit[i : i + thick.shape[0], j : j + thick.shape[1]]
    assert thick.mean() < 0.01
    # Its energy of gradients is shared by both axes.
    down, across = (np.mean(np.diff(target, axis=axis) ** 2) for axis in (0, 1))
    assert 0.5 < down / across < 2
    other = contour_target(jax.random.split(key)[0], GRID, feature=80 * um, line_width=8 * um)
    assert float(match_error(jnp.asarray(target), other)) > 0.5


def test_retrieval_of_a_lens(key):
    """A target of one point: the mask becomes a lens, with the peak that its aperture can have."""
    point = np.zeros(GRID.shape)
    point[20, 50] = 1.0
    found = retrieve_phase(jnp.asarray(point), GRID, PATH, shape=(40, 48), key=key, steps=3)
    blank = MaskBlank((40, 48), GRID.pitch, 1.5)
    mask = blank.mask(found.phase / (2 * np.pi) * blank.wrap_height(532 * nm))
    camera = tc.LenslessCamera(mask, tc.Sensor(GRID.shape, GRID.pitch), 2.0)
    h = tc.psf(
        camera,
        wavelength=532 * nm,
        model=tc.PsfMethod("angular_spectrum", oversampling=1),
        pixel_integration=False,
    )
    assert np.unravel_index(np.argmax(h), h.shape) == (20, 50)
    # Strehl: a perfect lens of this aperture has (ab/λf)².
    perfect = (40 * 48 * float(GRID.pitch) ** 2 / (532 * nm * 2.0)) ** 2
    assert float(h[20, 50]) > 0.93 * perfect


def test_retrieval_comes_nearer_to_contours(key):
    target = contour_target(key, GRID, feature=80 * um, line_width=8 * um)
    found = retrieve_phase(target, GRID, PATH, shape=(64, 80), key=key, steps=30)
    assert float(found.error[-1]) < 0.35 < 0.7 < float(found.error[0])
    assert 0 <= float(found.phase.min()) and float(found.phase.max()) <= 2 * np.pi


def test_refusals(key):
    with pytest.raises(ValueError, match="feature = 0.01 mm and line_width = 0.008 mm on samples"):
        contour_target(key, GRID, feature=10 * um, line_width=8 * um)
    with pytest.raises(ValueError, match="no contour of the levels"):
        contour_target(key, GRID, feature=80 * um, line_width=8 * um, levels=(5.0,))
    with pytest.raises(ValueError, match="line_width = 0.09 mm .* lines within the feature"):
        contour_target(key, GRID, feature=80 * um, line_width=90 * um)
    flat = jnp.ones(GRID.shape)
    with pytest.raises(ValueError, match="have no common centre"):
        retrieve_phase(flat, GRID, PATH, shape=(41, 48), key=key)
    with pytest.raises(ValueError, match="give irradiances >= 0, not all 0"):
        retrieve_phase(0 * flat, GRID, PATH, shape=(40, 48), key=key)


@pytest.mark.thorough
def test_the_mask_of_contours_concentrates_light_on_them():
    blank = masks.MaskBlank((48, 48), 10 * um, 1.52)
    mask = contour_mask(3, blank, PATH, feature=80 * um, line_width=20 * um)
    assert 0 <= float(mask.height.min()) and float(mask.height.max()) < 1.1e-3  # one turn
    lines = contour_target(jax.random.key(3), blank.grid, feature=80 * um, line_width=20 * um)
    camera = tc.LenslessCamera(mask, tc.Sensor((48, 48), 10 * um), float(PATH.distance))
    light = {"wavelength": float(PATH.wavelength), "object_distance": float(PATH.object_distance)}
    h = np.asarray(tc.psf(camera, model="angular_spectrum", **light, pixel_integration=False))
    on = np.asarray(lines) > 0
    assert h[on].mean() > 2 * h[~on].mean()
