"""Grey masks in open and closed cells, by local means, PSFs and files."""

import jax
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless.masks.halftone import halftone
from thincam_jax.units import um

GREY = tc.FresnelZoneAperture(150.0, 0.4, width=0.48, height=0.32, centre=(0.05, -0.1))


@pytest.mark.parametrize(("density", "power"), [("amplitude", 1), ("irradiance", 2)])
def test_open_fraction_is_the_grey_level(density, power):
    """Mean over squares of 16 × 16 cells, against that of the grey mask; a row errs by its edge."""
    plate = halftone(GREY, 2 * um, density)
    cells = np.asarray(plate.amplitude)
    assert cells.shape == (160, 240) and set(np.unique(cells)) == {0, 1}
    np.testing.assert_array_equal(plate.centre, GREY.centre)
    y, x = (2 * um * (np.arange(n) - (n - 1) / 2) for n in cells.shape)
    wanted = ((1 + np.cos(150.0 * (y[:, None] ** 2 + x**2) + 0.4)) / 2) ** power
    found, wanted = (v.reshape(10, 16, 15, 16).mean(axis=(1, 3)) for v in (cells, wanted))
    np.testing.assert_allclose(found, wanted, atol=0.06)
    assert abs(found.mean() - wanted.mean()) < 0.01


def test_a_picture_of_the_cells_is_the_mask(tmp_path):
    plate = halftone(GREY, 8 * um)
    path = tc.measured.write_image(tmp_path / "plate.png", plate.amplitude[None])
    np.testing.assert_array_equal(tc.read_mask(path, 8 * um).amplitude, plate.amplitude)


@pytest.mark.parametrize(
    ("mask", "cell", "error", "message"),
    [
        (GREY, 7 * um, ValueError, "cell"),
        (tc.SampledMask([[1j, 1.0]], 0.1), 0.1, ValueError, "give amplitude transmittances from 0"),
        (tc.SampledMask([[1.5, 1.0]], 0.1), 0.1, ValueError, "give amplitude transmittances from"),
        (tc.PhaseMask(np.ones((3, 4)) * um, 0.1, 1.5), 0.1, TypeError, "no grey to halftone"),
        (tc.LensletArray(2.0, 0.1, (3, 3)), 0.1, TypeError, "no grey to halftone"),
    ],
)
def test_other_masks_are_refused(mask, cell, error, message):
    with pytest.raises(error, match=message):
        halftone(mask, cell)


def test_sizes_are_known():
    with pytest.raises(TypeError, match="call it outside of jit"):
        jax.jit(lambda beta: halftone(tc.FresnelZoneAperture(beta, width=0.48), 8 * um))(150.0)
    with pytest.raises(ValueError, match="density"):
        halftone(GREY, 8 * um, "phase")  # pyright: ignore
