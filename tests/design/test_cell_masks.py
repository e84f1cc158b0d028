"""Masks of free cells: their levels, and their PSFs against integrals and another propagation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import value_and_slope
from thincam_jax.design.cell_masks import (
    LEVELS,
    CellMasks,
    CellOptics,
    drawn_cells,
    without_lone_cells,
)

CELL, COUNT, FAR = 0.03, 24, 120.0


def space(**changed):
    given = {"distance": 4.0, "wavelength": 5e-4} | changed
    return CellMasks(CELL, COUNT, **given)


def drawn(seed=0):
    return np.random.default_rng(seed).random((COUNT, COUNT)) < 0.4


def transfer(cells, u):
    """The Fourier integral of the PSF at (0, u): sums over overlaps of the cells with themselves.

    ∬ t(y, x + s/2) t(y, x − s/2) exp(−2πi M u x) dy dx with s = λ d u.
    """
    magnification, s = 1 + 4.0 / FAR, 5e-4 * 4.0 * u
    edges = (np.arange(COUNT + 1) - COUNT / 2) * CELL
    ends = np.unique(np.concatenate([edges - s / 2, edges + s / 2]))
    middles, k = (ends[1:] + ends[:-1]) / 2, 2 * np.pi * magnification * u

    def at(x):
        index = np.floor(x / CELL + COUNT / 2).astype(int)
        inside = (index >= 0) & (index < COUNT)
        return cells[:, np.clip(index, 0, COUNT - 1)] * inside

    product = np.sum(at(middles + s / 2) * at(middles - s / 2), axis=0) * CELL
    waves = (np.exp(-1j * k * ends[1:]) - np.exp(-1j * k * ends[:-1])) / (-1j * k)
    return magnification**2 * np.sum(product * waves)


def test_psf_has_the_transfer_function_of_overlaps():
    """With finer samples less of the light beyond their band is missed."""
    cells, u = drawn(), np.array([1.3, 5.0, 9.7])
    wanted, errors = np.array([transfer(cells * 1.0, f) for f in u]), []
    for pitch in (0.02, 0.0025):
        optics = CellOptics(space(), FAR, pitch)
        psf, step = np.asarray(optics(jnp.asarray(cells * 1.0))), float(optics.grid.pitch)
        waves = np.exp(-2j * np.pi * u * np.asarray(optics.grid.x)[:, None])
        found = step**2 * (psf.sum(0) @ waves) / np.sinc(step * u)
        errors.append(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
    assert errors[0] < 0.1
    assert errors[1] < 0.005


@pytest.mark.parametrize("levels", LEVELS)
def test_psf_is_that_of_the_mask_that_is_made(levels):
    numbers = jnp.asarray(np.random.default_rng(1).normal(size=(2, COUNT**2)))
    free = space(levels=levels, captures=2)
    optics, masks = CellOptics(free, FAR, 0.005), free.masks(numbers)
    for mask, amplitude in zip(masks, free.amplitudes(free.parts(numbers)), strict=True):
        camera = tc.LenslessCamera(mask, tc.Sensor(optics.grid.shape, optics.grid.pitch), 4.0)
        exact = tc.psf(camera, wavelength=5e-4, object_distance=FAR, model=_fine())
        found, middle = optics(amplitude), slice(60, -60)
        difference = (found - exact)[middle, middle]
        assert jnp.linalg.norm(difference) < 0.05 * jnp.linalg.norm(exact[middle, middle])


def _fine():
    return tc.PsfMethod("separable", nodes=4)


def test_cells_of_a_display_leak_and_have_gaps():
    """Against the displayed mask by the exact model, and what the levels are."""
    shown = space(fill_factor=0.64, contrast=100.0)
    numbers = jnp.asarray(drawn(6).reshape(1, -1) - 0.5)
    (mask,), (amplitude,) = shown.masks(numbers), shown.amplitudes(shown.parts(numbers))
    np.testing.assert_allclose(np.unique(amplitude), [0.1, 1.0], rtol=1e-6)
    optics = CellOptics(shown, FAR, 0.005)
    camera = tc.LenslessCamera(mask, tc.Sensor(optics.grid.shape, optics.grid.pitch), 4.0)
    exact = tc.psf(camera, wavelength=5e-4, object_distance=FAR, model=_fine())
    middle = slice(60, -60)
    difference = (optics(amplitude) - exact)[middle, middle]
    assert jnp.linalg.norm(difference) < 0.05 * jnp.linalg.norm(exact[middle, middle])
    whole = CellOptics(space(), FAR, 0.005)(amplitude)
    assert jnp.linalg.norm((whole - exact)[middle, middle]) > 0.3 * jnp.linalg.norm(exact)
    with pytest.raises(ValueError, match="are all open: leave the contrast out"):
        space(levels="phase", contrast=100.0)


@pytest.mark.parametrize("split", [2, 8])
def test_cells_in_parts(split):
    """The same PSF of whole cells in parts, and that of finer cells where parts differ."""
    optics, cells = CellOptics(space(), FAR, 0.02), jnp.asarray(drawn(8) * 1.0)
    in_parts = CellOptics(space(), FAR, 0.02, split=split)
    whole = jnp.kron(cells, jnp.ones((split, split)))
    np.testing.assert_allclose(in_parts(whole), optics(cells), atol=1e-9)


def test_cells_in_parts_that_differ():
    """Against as many finer cells, whose window is as wide and whose samples are the same."""
    rough = jnp.asarray(np.random.default_rng(9).random((2 * COUNT, 2 * COUNT)))
    in_parts = CellOptics(space(), FAR, CELL / 2, split=2)
    finer = CellMasks(CELL / 2, 2 * COUNT, distance=4.0, wavelength=5e-4)
    exact = CellOptics(finer, FAR, CELL / 2, cells=2 * in_parts.cells)
    assert in_parts.samples == 2 * exact.samples
    np.testing.assert_allclose(in_parts(rough), exact(rough), atol=1e-9)


def test_lone_cells_are_cleared():
    cells = np.zeros((6, 7))
    cells[1, 1] = cells[0, 4] = 1  # alone; the second at the rim
    cells[3:6, 3:6] = 1
    cells[4, 4] = 0  # a hole
    cells[2, 2] = cells[3, 2] = 1
    found = np.asarray(without_lone_cells(jnp.asarray(cells)))
    wanted = cells.copy()
    wanted[1, 1] = wanted[0, 4] = 0
    wanted[4, 4] = 1
    np.testing.assert_array_equal(found, wanted)
    board = jnp.asarray(np.indices((8, 8)).sum(0) % 2 * 1.0)
    assert not without_lone_cells(board).any()
    several = np.random.default_rng(7).random((2, 30, 30)) < 0.5
    cleared = np.asarray(without_lone_cells(jnp.asarray(several * 1.0)))
    np.testing.assert_array_equal(without_lone_cells(jnp.asarray(cleared)), cleared)


def test_psf_of_another_distance_on_the_grid_of_one():
    """Its shadow's size is kept: Fourier sums of it, up to half of the Nyquist frequency."""
    cells, u = jnp.asarray(drawn() * 1.0), np.linspace(-1, 1, 41) / 0.02
    own = CellOptics(space(), FAR, 0.005)
    near = CellOptics(space(), 60.0, 0.005, cells=own.cells)
    shown = CellOptics(space(), 60.0, 0.005, cells=own.cells, focus=FAR)

    def sums(optics):
        waves = np.exp(-2j * np.pi * u[:, None] * np.asarray(optics.grid.x))
        return float(optics.grid.pitch) ** 2 * (waves @ np.asarray(optics(cells)) @ waves.T)

    assert shown.grid.pitch == own.grid.pitch and shown.grid.shape == own.grid.shape
    size = np.linalg.norm(sums(near))
    assert np.linalg.norm(sums(shown) - sums(near)) < 0.01 * size
    assert np.linalg.norm(sums(own) - sums(near)) > 0.25 * size


def test_levels():
    numbers = jnp.asarray(np.random.default_rng(2).normal(size=(1, COUNT**2)))
    binary, grey, signs, phases = (
        space(levels=levels).amplitudes(space(levels=levels).parts(numbers)) for levels in LEVELS
    )
    assert set(np.unique(binary)) == {0.0, 1.0}
    assert 0 < grey.min() < grey.max() < 1
    assert set(np.unique(signs)) == {-1.0, 1.0}
    np.testing.assert_allclose(jnp.abs(phases), 1.0, rtol=1e-12)
    soft = space().parts(numbers, 1.0)
    assert jnp.all((soft > 0.5) == (binary.reshape(soft.shape) == 1))


def test_rings_are_round():
    free = space(rings=True)
    cells = free.amplitudes(jnp.asarray(np.random.default_rng(3).random((1, free.free))))[0]
    np.testing.assert_array_equal(cells, cells[::-1, ::-1])
    np.testing.assert_array_equal(cells, cells.T)
    assert free.free < COUNT
    assert drawn_cells(free, np.random.default_rng(0)).shape == (1, free.free)


def test_slope_and_batches():
    free, rng = space(levels="grey"), np.random.default_rng(4)
    optics = CellOptics(free, FAR, 0.02)
    numbers = jnp.asarray(rng.normal(size=(1, COUNT**2)))
    weight = jnp.asarray(rng.normal(size=optics.grid.shape))

    def cost(x):
        return jnp.sum(weight * optics(free.amplitudes(free.parts(x))[0]))

    way = jnp.asarray(rng.normal(size=numbers.shape))
    value, slope = value_and_slope(cost)
    exact, numbers, way = float(np.sum(slope(numbers) * way)), np.asarray(numbers), np.asarray(way)
    step = (value(numbers + 1e-5 * way) - value(numbers - 1e-5 * way)) / 2e-5
    assert exact == pytest.approx(float(step), rel=1e-6)
    several = jax.jit(jax.vmap(cost))(np.stack([numbers, 2 * numbers]))
    assert several[1] == pytest.approx(float(value(2 * numbers)), rel=1e-12)


def test_drawn_masks_fit():
    rng = np.random.default_rng(5)
    every = [drawn_cells(space(captures=2), rng) for _ in range(30)]
    assert {cells.shape for cells in every} == {(2, COUNT**2)}
    assert len({int(cells.sum()) for cells in every}) > 10


def test_too_many_cells_are_refused():
    vast = CellMasks(0.001, 4096, distance=400.0, wavelength=5e-4)
    with pytest.raises(MemoryError, match="fewer or larger cells"):
        CellOptics(vast, FAR, 0.0001)
