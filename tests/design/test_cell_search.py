"""The search for cells: better than random masks, resumed to the bit, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax.design.cell_search as cell_search
from thincam_jax.design import PhotonNoise, PowerLaw, Setup
from thincam_jax.design.cell_masks import CellMasks
from thincam_jax.design.cell_search import CellSettings, find_cells

SETUP = Setup(0.04, 1.28, 100.0, 40.0, noise=PhotonNoise(3e5, 20.0), prior=PowerLaw(2.5))
FEW = CellSettings(draws=12, starts=2, steps=10, flips=8)


def space(**changed):
    return CellMasks(0.04, 24, distance=3.0, wavelength=5e-4, **changed)


@pytest.mark.parametrize("levels", ["binary", "phase"])
def test_beats_the_best_random_masks(levels):
    steps = CellSettings(draws=12, starts=2, steps=15, flips=8, rate=0.3)
    found = find_cells(SETUP, space(levels=levels), steps)
    assert found.error < 0.97 * found.random
    assert np.isfinite(found.history).all()
    assert len(found.history) == 45
    assert "found" in str(found)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "changed", [{"levels": "grey"}, {"levels": "binary_phase"}, {"rings": True}]
)
def test_beats_random_masks_of_other_kinds(changed):
    steps = CellSettings(draws=12, starts=2, steps=30, flips=8, rate=0.3)
    found = find_cells(SETUP, space(**changed), steps)
    assert found.error <= found.random


def test_flips_never_harm():
    with_flips, without = (
        find_cells(SETUP, space(), CellSettings(8, 1, 4, flips=n)) for n in (12, 0)
    )
    assert with_flips.error < without.error
    cells = np.asarray(with_flips.masks[0].amplitude)
    assert set(np.unique(cells)) == {0.0, 1.0}


def test_goes_on_from_its_folder_to_the_bit(tmp_path, monkeypatch):
    whole = find_cells(SETUP, space(captures=2), FEW)
    stepped, count = cell_search._Problem.stepped, [0]

    def interrupted(*given):
        count[0] += 1
        if count[0] in (20, 40):
            raise KeyboardInterrupt
        return stepped(*given)

    monkeypatch.setattr(cell_search._Problem, "stepped", interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            find_cells(SETUP, space(captures=2), FEW, folder=tmp_path)
    again = find_cells(SETUP, space(captures=2), FEW, folder=tmp_path)
    np.testing.assert_array_equal(again.numbers, whole.numbers)
    np.testing.assert_array_equal(again.history, whole.history)
    assert (again.error, again.random) == (whole.error, whole.random)


def test_what_it_refuses(tmp_path):
    find_cells(SETUP, space(), FEW, folder=tmp_path)
    with pytest.raises(ValueError, match="a search for other masks; give another folder"):
        find_cells(SETUP, space(), CellSettings(12, 2, 11, flips=8), folder=tmp_path)
    (tmp_path / "search.npz").write_bytes(b"no arrays")
    with pytest.raises(ValueError, match=r"search\.npz: holds no search; give another folder"):
        find_cells(SETUP, space(), FEW, folder=tmp_path)
    with pytest.raises(ValueError, match=r"start has shape \(1, 4\); give \(capture, free\)"):
        find_cells(SETUP, space(), FEW, start=jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match="steps"):
        CellSettings(steps=0)


def test_no_new_program_for_new_values():
    find_cells(SETUP, space(), CellSettings(2, 1, 3, flips=1))
    traced = cell_search._adam_step._cached._cache_size()  # pyright: ignore
    brighter = SETUP.replace(noise=PhotonNoise(1e5, 5.0))
    find_cells(
        brighter, space().replace(wavelength=5.2e-4), CellSettings(2, 1, 3, flips=1, rate=0.2)
    )
    assert cell_search._adam_step._cached._cache_size() == traced  # pyright: ignore
