"""The PSF of a MURA of 101 × 101 cells: `separable` against a padded FFT, in one run.

1024×1024 pixels of 5 µm, cells of 30 µm, 550 nm, d = 2 mm. Both in single precision, compiled
beforehand, the result waited for. The FFT is `angular_spectrum` at a sample a pixel on a window of
4096×4096, twice the smallest on which nothing wraps round: its cells are cut by the samples, whose
mean transmittance it takes. Errors are relative L2 from the sum over all cells in NumPy and SciPy,
cell by cell from the code's definition: nothing of the package is in it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import thincam_jax as tc
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum
from thincam_jax.lensless.propagation.separable import separable

ORDER, CELL, PITCH, SHAPE = 101, 30e-3, 5e-3, (1024, 1024)
WAVELENGTH, DISTANCE = 550e-6, 2.0
RESULTS: dict[str, tuple[float, float]] = {}


def psf(model, cell, distance):
    mask = tc.ModifiedUniformlyRedundantArray(ORDER, cell, centre=jnp.zeros(2, cell.dtype))
    grid = tc.Grid(SHAPE, jnp.asarray(PITCH, cell.dtype))
    path = LightPath(
        jnp.asarray(WAVELENGTH, cell.dtype), distance, jnp.asarray(jnp.inf, cell.dtype)
    )
    if model == "separable":
        return separable(mask, grid, path, pixel_integration=False).image()
    method = PsfMethod("angular_spectrum", pixel_integration=False, mask_shape=SHAPE)
    return angular_spectrum(mask, grid, path, method, padding=2.0)


@pytest.fixture(scope="module")
def reference():
    """|Σ_ij A_ij F_i(y) F_j(x)|², a Fresnel integral for each cell."""
    squares = {n * n % ORDER for n in range(1, ORDER)}
    c = np.array([1 if i in squares else -1 for i in range(ORDER)])
    cells = (np.outer(c, c) == 1).astype(float)
    cells[:, 0], cells[0] = 1, 0
    x = (np.arange(SHAPE[1]) - (SHAPE[1] - 1) / 2) * PITCH
    edges = (np.arange(ORDER + 1) - ORDER / 2) * CELL
    s, c = scipy.special.fresnel((edges - x[:, None]) * np.sqrt(2 / (WAVELENGTH * DISTANCE)))
    slits = np.diff(c + 1j * s, axis=1) / np.sqrt(2)
    return np.abs(slits @ cells @ slits.T) ** 2


@pytest.mark.parametrize(("model", "rounds"), [("separable", 30), ("angular_spectrum", 5)])
def test_mura(benchmark, reference, model, rounds):
    numbers = jnp.asarray(CELL, jnp.float32), jnp.asarray(DISTANCE, jnp.float32)
    compiled = jax.jit(lambda *n: psf(model, *n)).lower(*numbers).compile()
    value = np.asarray(compiled(*numbers), float)
    error = np.linalg.norm(value - reference) / np.linalg.norm(reference)
    benchmark.pedantic(
        lambda: jax.block_until_ready(compiled(*numbers)), rounds=rounds, warmup_rounds=1
    )
    benchmark.extra_info["error"] = error
    RESULTS[model] = benchmark.stats.stats.median, error


def test_zz_ratio(capsys):
    (exact, exact_error), (sampled, sampled_error) = (
        RESULTS[m] for m in ("separable", "angular_spectrum")
    )
    with capsys.disabled():
        print(
            f"\nMURA {ORDER}: separable {exact * 1e3:.1f} ms, error {exact_error:.1e}; "
            f"FFT {sampled * 1e3:.0f} ms, error {sampled_error:.1e}; {sampled / exact:.0f} times"
        )
    assert sampled > 50 * exact
    assert exact_error < 1e-3 * sampled_error
