"""The search for cells: better than random masks, resumed to the bit, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax.design.cell_search as cell_search
from helpers import quick
from thincam_jax.design import PhotonNoise, PowerLaw, Setup
from thincam_jax.design.cell_masks import CellMasks, CellOptics, without_lone_cells
from thincam_jax.design.cell_search import CellSettings, find_cells
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.objectives import Tolerances

SETUP = Setup(0.04, 1.28, 100.0, 40.0, noise=PhotonNoise(3e5, 20.0), prior=PowerLaw(2.5))
FEW = CellSettings(draws=12, starts=2, steps=10, flips=8)


def space(**changed):
    return CellMasks(0.04, 24, distance=3.0, wavelength=5e-4, **changed)


@pytest.mark.parametrize("levels", quick(["binary", "phase"], 0))
def test_beats_the_best_random_masks(levels):
    steps = CellSettings(draws=12, starts=2, steps=15, flips=8, rate=0.3)
    found = find_cells(SETUP, space(levels=levels), steps)
    assert found.error < 0.97 * found.random
    assert np.isfinite(found.history).all()
    assert len(found.history) == 45
    assert "found" in str(found)


def test_a_start_is_never_lost():
    """A descent whose rate ruins it ends above where it began; the start is flipped as well."""
    wild = CellSettings(draws=2, starts=1, steps=10, flips=0, rate=9.0)
    start = jnp.asarray(find_cells(SETUP, space(), FEW).numbers)
    judge = cell_search.CellJudge.of(SETUP, space(), nodes=4)
    error = judge(space().amplitudes(space().parts(start)))
    found = find_cells(SETUP, space(), wild, start=start)
    assert found.error < float(error) * (1 + 1e-6)


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


def test_lone_cells_can_be_forbidden():
    settings = CellSettings(8, 1, 4, flips=12, lone_cells=False)
    found = find_cells(SETUP, space(), settings)
    cells = found.masks[0].amplitude
    np.testing.assert_array_equal(without_lone_cells(cells), cells)
    assert found.error < found.random
    with pytest.raises(ValueError, match="lone_cells=False is for binary levels"):
        find_cells(SETUP, space(levels="grey"), settings)


def test_tolerances_are_kept():
    """The error that is found is the mean over them, of images made for the exact masks; a mask
    found for them is better over them than one that is not."""
    tolerances = Tolerances(distance=0.15, wavelength=1e-5)
    settings = CellSettings(8, 1, 4, flips=12)
    robust, exact = (find_cells(SETUP, space(), settings, tolerances=t) for t in (tolerances, None))

    def mean(design):
        own = CellOptics(space(), 100.0, 0.04)
        error = ExpectedError(SETUP, [own.grid], [3.0], nodes=4, padding=1.25)
        psf, total = own(design.masks[0].amplitude), 0.0
        for changed in (
            ({"distance": 2.85}, {"distance": 3.15}),
            ({"wavelength": 4.9e-4}, {"wavelength": 5.1e-4}),
        ):
            moved = [
                CellOptics(space().replace(**c), 100.0, 0.04, cells=own.cells, focus=100.0)
                for c in changed
            ]
            each = [error([m(design.masks[0].amplitude)], assumed=[psf]) for m in moved]
            total += sum(each) / 2 - error([psf])
        return error([psf]) + total

    assert robust.error == pytest.approx(float(mean(robust)), rel=1e-6)
    assert robust.error < mean(exact)
    with pytest.raises(ValueError, match="cells have no β"):
        find_cells(SETUP, space(), settings, tolerances=Tolerances(beta=0.01))


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
