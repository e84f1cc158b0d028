"""Files of masks found, as other programs read them, judged again."""

import jax.numpy as jnp
import klayout.db
import numpy as np
import PIL.Image
import pytest

import thincam_jax as tc
from thincam_jax.design import PhotonNoise, PowerLaw, Setup
from thincam_jax.design.cell_masks import CellMasks, CellOptics
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.phase_mask import mask_of_phase, one_turn
from thincam_jax.design.relief_files import read_height_map, write_height_map
from thincam_jax.lensless.masks import MaskBlank
from thincam_jax.lensless.masks.halftone import halftone

SETUP = Setup(0.04, 1.28, 100.0, 40.0, noise=PhotonNoise(3e5, 20.0), prior=PowerLaw(2.5))
CELL, COUNT = 0.04, 24


def space(**changed):
    return CellMasks(CELL, COUNT, distance=3.0, wavelength=5e-4, **changed)


def found(**changed):
    """Masks of numbers as a search ends with."""
    numbers = np.random.default_rng(0).normal(size=(1, COUNT**2)) - 0.5
    return space(**changed).masks(jnp.asarray(numbers))[0]


def decibels(cells, split=1):
    optics = CellOptics(space(), 100.0, 0.04, split=split)
    error = ExpectedError(SETUP, [optics.grid], [3.0])
    return 10 * np.log10(float(error([optics(jnp.asarray(cells))])))


def layout(path, side):
    """Squares of a layout that its boxes cover, rows downwards."""
    read = klayout.db.Layout()
    read.read(str(path))
    region = klayout.db.Region(read.top_cell().begin_shapes_rec(read.layer(1, 0)))
    count, nm = round(COUNT * CELL / side), round(1e6 * side)
    opened = np.zeros((count, count))
    for polygon in region.each():
        assert polygon.is_box()
        box = polygon.bbox()
        edges = [n / nm + count / 2 for n in (-box.top, -box.bottom, box.left, box.right)]
        np.testing.assert_array_equal(edges, np.round(edges))
        top, bottom, left, right = (int(n) for n in edges)
        opened[top:bottom, left:right] += 1
    return opened


def test_layout_and_picture_of_a_mask_found(tmp_path):
    mask = found()
    tc.design.write_gds(tmp_path / "mask.gds", mask, smallest_feature=CELL)
    tc.measured.write_image(tmp_path / "mask.png", mask.amplitude[None], percentile=100)
    with PIL.Image.open(tmp_path / "mask.png") as picture:
        shown = np.asarray(picture)
    assert set(np.unique(shown)) == {0, 255}
    cells = layout(tmp_path / "mask.gds", CELL)
    np.testing.assert_array_equal(cells, mask.amplitude)
    np.testing.assert_array_equal(shown.reshape(COUNT, COUNT, -1)[..., 0] / 255, mask.amplitude)
    again = tc.read_mask(tmp_path / "mask.png", CELL).amplitude
    for read in (cells, again):
        assert decibels(read) == pytest.approx(decibels(mask.amplitude), abs=1e-6)


def test_layout_of_grey_cells_as_half_tone(tmp_path):
    """The PSF nears that of the grey mask as half-tone cells grow finer."""
    mask, changed = found(levels="grey"), []
    exact = np.asarray(CellOptics(space(), 100.0, 0.04)(mask.amplitude))
    for split in (2, 8):
        plate = halftone(mask, CELL / split)
        tc.design.write_gds(tmp_path / "grey.gds", plate, smallest_feature=CELL / split)
        parts = layout(tmp_path / "grey.gds", CELL / split)
        np.testing.assert_array_equal(parts, plate.amplitude)
        psf = CellOptics(space(), 100.0, 0.04, split=split)(jnp.asarray(parts))
        changed.append(np.linalg.norm(psf - exact) / np.linalg.norm(exact))
        assert decibels(parts, split) == pytest.approx(decibels(mask.amplitude), abs=0.5)
    assert changed[1] < 0.6 * changed[0]


def test_height_map_of_phases_found(tmp_path):
    """Eight levels are written exactly enough: the error changes by less than 0.05 dB."""
    mask, blank = found(levels="phase"), MaskBlank((COUNT, COUNT), CELL, 1.52)
    made = mask_of_phase(jnp.angle(mask.amplitude), blank, 5e-4, one_turn(blank, 5e-4, 8))
    write_height_map(tmp_path / "relief.png", made, wavelength=5e-4)
    read = read_height_map(tmp_path / "relief.png")
    waves = [np.exp(2j * np.pi * np.asarray(one.turns(5e-4))) for one in (made, read)]
    assert decibels(waves[1]) == pytest.approx(decibels(waves[0]), abs=0.05)
    assert decibels(waves[0]) != pytest.approx(decibels(mask.amplitude), abs=1e-3)
