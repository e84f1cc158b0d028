"""The best member of each kind of mask: judged alike, sorted, and where a search goes on from."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design.cell_masks import CellMasks, CellOptics
from thincam_jax.design.cell_search import CellSettings, find_cells
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.recommendation import KINDS, recommend

SETUP = tc.design.Setup(0.02, 1.28, 100.0, 40.0, noise=tc.design.PhotonNoise(1e5, 4.0))
SPACE = CellMasks(0.04, 24, distance=3.0, wavelength=5e-4)


@pytest.fixture(scope="module")
def found():
    return recommend(SETUP, SPACE)


def test_every_kind_by_its_best_member(found):
    errors = [one.error for one in found]
    assert errors == sorted(errors) and 0 < errors[0] < errors[-1] < 1
    assert {one.kind for one in found} >= {*KINDS} - {"diffuser"}  # cells too coarse for a relief
    assert len({one.kind for one in found}) == len(found)
    for one in found:
        assert all(np.max(np.abs(mask.amplitude)) <= 1 + 1e-6 for mask in one.masks)
        assert len(one.masks) == (4 if one.kind in ("fringe scanning", "method B") else 1)
        assert one.kind in str(found) and one.member in str(found)
    assert str(found).startswith("Judged by PSFs on the axis")


def test_a_dark_mask_is_not_the_best_at_a_signal_to_noise_ratio():
    """Noise at an SNR has no value for it: of 16 cells drawn at random most masks are dark."""
    even = SETUP.replace(noise=tc.design.SignalNoise(30.0))
    (best,) = recommend(even, SPACE.replace(count=4), kinds=("random cells",))
    assert 0 < best.error < 1
    assert best.amplitudes.any()


def test_errors_are_those_of_exact_psfs(found):
    """By another propagation, on a sensor wider than the masks."""
    wide = tc.Sensor((96, 96), 0.02)
    for one in found[:3]:
        cameras = [tc.LenslessCamera(mask, wide, 3.0) for mask in one.masks]
        psfs = [tc.psf(c, wavelength=5e-4, object_distance=100.0) for c in cameras]
        error = ExpectedError(SETUP, [wide.grid] * len(psfs), [3.0] * len(psfs), padding=1.25)
        assert 10 * np.log10(float(error(psfs))) == pytest.approx(one.decibels, abs=0.25)


def test_depths_are_judged_by_the_image_for_the_middle_one():
    kinds = ("zone aperture",)
    (flat,), (deep,) = (
        recommend(SETUP, SPACE, depths=depths, kinds=kinds) for depths in (None, (50.0, 100.0, 1e4))
    )
    assert deep.error > flat.error
    own = CellOptics(SPACE, 100.0, 0.02)
    error = ExpectedError(SETUP, [own.grid], [3.0], padding=1.25)
    (mask,) = jnp.asarray(deep.amplitudes)
    moved = [CellOptics(SPACE, t, 0.02, cells=own.cells, focus=100.0)(mask) for t in (50.0, 1e4)]
    each = [error([own(mask)]), *(error([m], assumed=[own(mask)]) for m in moved)]
    assert deep.error == pytest.approx(float(np.mean(each)), rel=1e-6)


def test_a_search_goes_on_from_it(found):
    best = next(one for one in found if one.kind == "one opening")
    settings = CellSettings(1, 1, steps=1, flips=10)
    refined = find_cells(SETUP, SPACE, settings, start=best.numbers)
    assert refined.error < 1.2 * best.error
    scanned = next(one for one in found if one.kind == "fringe scanning")
    with pytest.raises(ValueError, match="fringe scanning are not open and closed cells"):
        _ = scanned.numbers


def test_unknown_kinds_are_refused():
    with pytest.raises(ValueError, match="kinds has 'lens'; give some of one opening, MURA"):
        recommend(SETUP, SPACE, kinds=("MURA", "lens"))
